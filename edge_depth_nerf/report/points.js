"use strict";
// LiDAR points and cameras in 3D; the script of the pictures calls `pointsView.open` with a drive's points
const pointsView = (() => {
  const section = document.querySelector("#points");
  const canvas = section.querySelector("canvas");
  const PATH = [41, 160, 219];
  const HELD_OUT = [235, 125, 0];
  const SETTLED_MS = 1500;
  const TURN = Math.PI / 36;
  // nothing is drawn before the section is visible
  let state = null;
  let shown = null;
  let seen = false;
  let until = 0;
  let waiting = false;

  const numbers = (text, Kind) => new Kind(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
  // the scene's z is up, the graphics' y
  const turned = ([x, y, z]) => [x, z, -y];

  const VERTEX = `
    attribute vec3 position;
    attribute vec3 colour;
    uniform mat4 modelViewMatrix;
    uniform mat4 projectionMatrix;
    uniform vec3 low;
    uniform vec3 span;
    uniform float size;
    varying vec3 tint;
    void main() {
      vec4 at = modelViewMatrix * vec4(low + span * position, 1.0);
      gl_Position = projectionMatrix * at;
      gl_PointSize = clamp(size / max(-at.z, 0.01), 1.5, 14.0);
      tint = colour;
    }`;
  const FRAGMENT = `
    precision mediump float;
    varying vec3 tint;
    void main() {
      gl_FragColor = vec4(tint, 1.0);
    }`;

  function start() {
    if (!document.createElement("canvas").getContext("webgl2")) {
      section.querySelector(".without-webgl").hidden = false;
      canvas.hidden = true;
      return null;
    }
    const renderer = new ogl.Renderer({ canvas, dpr: Math.min(window.devicePixelRatio, 2), antialias: true });
    renderer.gl.clearColor(0.09, 0.1, 0.11, 1);
    const camera = new ogl.Camera(renderer.gl, { fov: 55, near: 0.1, far: 2000 });
    const orbit = new ogl.Orbit(camera, { element: canvas, ease: 0.5, inertia: 0.6, rotateSpeed: 0.3 });
    // scrolling the page across it must not zoom
    orbit.enabled = false;
    canvas.addEventListener("pointerdown", () => (orbit.enabled = true));
    canvas.addEventListener("focus", () => (orbit.enabled = true));
    canvas.addEventListener("blur", () => (orbit.enabled = false));
    for (const name of ["pointerdown", "pointermove", "wheel", "touchmove"]) {
      canvas.addEventListener(name, again, { passive: true });
    }
    canvas.addEventListener("keydown", (event) => onKey(event, camera, orbit));
    section.querySelector("button").addEventListener("click", firstView);
    new ResizeObserver(() => {
      renderer.setSize(canvas.parentElement.clientWidth, canvas.parentElement.clientHeight);
      camera.perspective({ aspect: renderer.width / renderer.height });
      again();
    }).observe(canvas.parentElement);
    return { renderer, camera, orbit, scene: null, first: null };
  }

  function onKey(event, camera, orbit) {
    const away = new ogl.Vec3().copy(camera.position).sub(orbit.target);
    const radius = away.len();
    let azimuth = Math.atan2(away.x, away.z);
    let polar = Math.acos(away.y / radius);
    let zoom = 1;
    const moves = {
      ArrowLeft: () => (azimuth -= TURN),
      ArrowRight: () => (azimuth += TURN),
      ArrowUp: () => (polar -= TURN),
      ArrowDown: () => (polar += TURN),
      "+": () => (zoom = 0.9),
      "-": () => (zoom = 1.1),
    };
    if (!moves[event.key]) {
      return;
    }
    event.preventDefault();
    moves[event.key]();
    polar = Math.min(Math.max(polar, 0.02), Math.PI - 0.02);
    const level = zoom * radius * Math.sin(polar);
    camera.position
      .set(level * Math.sin(azimuth), zoom * radius * Math.cos(polar), level * Math.cos(azimuth))
      .add(orbit.target);
    orbit.forcePosition();
    again();
  }

  function draw() {
    waiting = false;
    if (!seen || !state.scene) {
      return;
    }
    state.orbit.update();
    state.renderer.render({ scene: state.scene, camera: state.camera });
    if (performance.now() < until) {
      waiting = true;
      requestAnimationFrame(draw);
    }
  }

  // draws until the last movement has settled
  function again() {
    until = performance.now() + SETTLED_MS;
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(draw);
    }
  }

  function firstView() {
    state.camera.position.set(...state.first.from);
    state.orbit.target.set(...state.first.at);
    state.orbit.forcePosition();
    again();
  }

  function build() {
    const { renderer, camera } = state;
    const { gl } = renderer;
    if (state.scene) {
      state.scene.children.forEach((mesh) => mesh.geometry.remove());
    }
    state.scene = new ogl.Transform();
    const middle = shown.paths[0][Math.floor(shown.paths[0].length / 2)];
    const away = (place) => turned(place.map((value, axis) => value - middle[axis]));
    const add = (attributes, mode, uniforms) => {
      const program = new ogl.Program(gl, {
        vertex: VERTEX,
        fragment: FRAGMENT,
        uniforms: Object.fromEntries(Object.entries(uniforms).map(([name, value]) => [name, { value }])),
      });
      new ogl.Mesh(gl, { geometry: new ogl.Geometry(gl, attributes), program, mode, frustumCulled: false }).setParent(
        state.scene,
      );
    };
    // the points' axes are turned here: their places are small numbers that the graphics read
    const steps = numbers(shown.steps, Uint16Array);
    const count = steps.length / 3;
    const places = new Uint16Array(steps.length);
    for (let index = 0; index < count; index++) {
      places[3 * index] = steps[3 * index];
      places[3 * index + 1] = steps[3 * index + 2];
      places[3 * index + 2] = steps[3 * index + 1];
    }
    const span = shown.step.map((step) => 65535 * step);
    add(
      {
        position: { size: 3, data: places, normalized: true },
        colour: { size: 3, data: numbers(shown.colours, Uint8Array), type: gl.UNSIGNED_BYTE, normalized: true },
      },
      gl.POINTS,
      { low: away(shown.low), span: [span[0], span[2], -span[1]], size: 60 },
    );
    const mark = (list, colour, mode, size) =>
      list.length &&
      add(
        {
          position: { size: 3, data: new Float32Array(list.flatMap(away)) },
          colour: { size: 3, data: new Uint8Array(list.flatMap(() => colour)), type: gl.UNSIGNED_BYTE, normalized: true },
        },
        mode,
        { low: [0, 0, 0], span: [1, 1, 1], size },
      );
    for (const path of shown.paths) {
      mark(path, PATH, gl.LINE_STRIP, 0);
    }
    mark(shown.training, PATH, gl.POINTS, 120);
    mark(shown.heldOut, HELD_OUT, gl.POINTS, 180);
    const ahead = turned(shown.forward);
    state.first = {
      from: [-14 * ahead[0], 8, -14 * ahead[2]],
      at: [6 * ahead[0], 0, 6 * ahead[2]],
    };
    canvas.dataset.points = String(count);
    firstView();
  }

  new IntersectionObserver((entries) => {
    seen = entries[entries.length - 1].isIntersecting;
    if (!seen || !shown) {
      return;
    }
    const begun = state === null;
    state = state || start();
    if (state && (begun || !state.scene)) {
      build();
    }
    if (state) {
      again();
    }
  }).observe(section);

  return {
    open(points) {
      shown = points;
      section.hidden = !points;
      if (state && points) {
        build();
      }
    },
  };
})();
