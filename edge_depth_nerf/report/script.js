"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const find = (selector) => document.querySelector(selector);
  const viewer = find(".viewer");
  const stage = find(".stage");
  const wipe = find(".wipe");
  const sides = { left: find("select[name=left]"), right: find("select[name=right]") };
  const driveChoice = find("select[name=drive]");
  const TRUTH = "truth";
  // which picture of the ground truth is shown beside an error
  const OF_TRUTH = { "colour-error": "colour", "distance-error": "distance" };
  const state = { drive: 0, view: 0, kind: "distance", left: "", right: "" };

  const drive = () => data.drives[state.drive];
  const view = () => drive().views[state.view];
  const kind = () => data.kinds.find((each) => each.key === state.kind);
  const titleOf = (name) => (name === TRUTH ? "ground truth" : name.slice(1));

  function make(tag, text, parent) {
    const element = document.createElement(tag);
    element.textContent = text;
    parent.append(element);
    return element;
  }

  function pictureOf(name) {
    const shown = view();
    if (name === TRUTH) {
      return shown.truth[shownKind(name).key] || shown.truth.colour;
    }
    return shown.rendered[name.slice(1)][state.kind];
  }

  // a view without known distances lacks some kinds
  function there(key) {
    return drive().methods.every((name) => view().rendered[name][key]);
  }

  function slide(percent) {
    const value = Math.min(Math.max(percent, 0), 100);
    wipe.value = value;
    stage.style.setProperty("--wipe", `${value}%`);
    wipe.setAttribute(
      "aria-valuetext",
      `${Math.round(value)} % ${titleOf(state.left)}, ${Math.round(100 - value)} % ${titleOf(state.right)}`,
    );
  }

  // the kind that a side shows: the ground truth has no error, so its colours or distances are shown beside one
  function shownKind(name) {
    const key = name === TRUTH ? OF_TRUTH[state.kind] || state.kind : state.kind;
    return data.kinds.find((each) => each.key === key);
  }

  function drawLegends() {
    const legends = find(".legends");
    legends.replaceChildren();
    const kinds = [...new Set([shownKind(state.left), shownKind(state.right)])];
    for (const { title, legend } of kinds.filter((each) => each.legend)) {
      const box = make("div", "", legends);
      box.className = "legend";
      const scale = make("div", kinds.length > 1 ? title : "", box);
      scale.className = "scale";
      const bar = document.createElement("img");
      bar.alt = "";
      bar.draggable = false;
      bar.src = legend.bar;
      scale.append(bar);
      const ticks = make("div", "", scale);
      ticks.className = "ticks";
      legend.ticks.forEach(([place, label], index) => {
        const last = index === legend.ticks.length - 1;
        make("span", last ? `${label} ${legend.unit}` : label, ticks).style.left = `${100 * place}%`;
      });
      const none = make("span", "none", box);
      none.className = "none";
      none.prepend(document.createElement("i"));
      box.style.setProperty("--none", legend.none);
    }
    find(".explanation").textContent = kind().explanation;
  }

  function drawFigures() {
    const figures = find(".figures");
    figures.replaceChildren();
    const table = make("table", "", figures);
    make("caption", view().title, table);
    const rows = drive().methods.map((name) => [`:${name}`, view().figures[name]]);
    const columns = Object.keys(rows[0][1]);
    const head = make("tr", "", make("thead", "", table));
    make("td", "", head);
    for (const title of columns) {
      make("th", title, head).scope = "col";
    }
    const body = make("tbody", "", table);
    for (const [name, found] of rows) {
      const row = make("tr", "", body);
      row.className = name === state.left || name === state.right ? "shown" : "";
      make("th", titleOf(name), row).scope = "row";
      for (const title of columns) {
        const values = rows.map(([, of]) => Number(of[title]));
        const best = title.includes("↓") ? Math.min(...values) : Math.max(...values);
        make("td", found[title], row).className = rows.length > 1 && Number(found[title]) === best ? "best" : "";
      }
    }
  }

  function draw() {
    if (!there(state.kind)) {
      state.kind = "colour";
    }
    for (const radio of document.querySelectorAll("input[name=kind]")) {
      radio.disabled = !there(radio.value);
      radio.checked = radio.value === state.kind;
    }
    const shown = view();
    stage.style.setProperty("--aspect", String(shown.width / shown.height));
    for (const [side, picture, tag] of [
      ["left", ".under", ".tag.left"],
      ["right", ".over", ".tag.right"],
    ]) {
      const name = state[side];
      const what = shownKind(name).title.toLowerCase();
      const image = find(picture);
      image.src = pictureOf(name);
      image.alt = `${side}: ${titleOf(name)}, ${what} of ${shown.title}`;
      const differ = shownKind(state.left) !== shownKind(state.right);
      find(tag).textContent = differ ? `${titleOf(name)}: ${what}` : titleOf(name);
      sides[side].value = name;
    }
    slide(Number(wipe.value));
    drawLegends();
    drawFigures();
  }

  function fillSelect(select, names) {
    select.replaceChildren();
    for (const name of names) {
      make("option", titleOf(name), select).value = name;
    }
  }

  function openDrive(index) {
    state.drive = index;
    state.view = 0;
    // a mark before each, because a method's title may be "truth"
    const names = [TRUTH, ...drive().methods.map((name) => `:${name}`)];
    for (const side of ["left", "right"]) {
      fillSelect(sides[side], names);
      if (!names.includes(state[side])) {
        // nerfacto comes first and ours last; one alone stands beside the ground truth
        state[side] = side === "left" && names.length > 2 ? names[1] : names[side === "left" ? 0 : names.length - 1];
      }
    }
    const thumbnails = find(".thumbnails");
    thumbnails.replaceChildren();
    drive().views.forEach((each, number) => {
      const label = make("label", "", thumbnails);
      const radio = document.createElement("input");
      radio.type = "radio";
      radio.name = "view";
      radio.value = String(number);
      radio.checked = number === 0;
      radio.setAttribute("aria-label", `${number + 1}: ${each.title}`);
      radio.addEventListener("change", () => {
        state.view = number;
        draw();
      });
      const image = document.createElement("img");
      image.alt = "";
      image.draggable = false;
      image.src = each.truth.colour;
      label.title = each.title;
      label.append(radio, image);
    });
    find(".drive-note").textContent = drive().note;
    if (find("#points")) {
      pointsView.open(drive().points);
    }
    draw();
  }

  function follow(event) {
    const box = stage.getBoundingClientRect();
    slide((100 * (event.clientX - box.left)) / box.width);
  }

  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) {
      return;
    }
    // a click would give the focus to the page
    event.preventDefault();
    wipe.focus({ preventScroll: true });
    stage.setPointerCapture(event.pointerId);
    follow(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (stage.hasPointerCapture(event.pointerId)) {
      follow(event);
    }
  });
  wipe.addEventListener("input", () => slide(Number(wipe.value)));
  for (const side of ["left", "right"]) {
    sides[side].addEventListener("change", () => {
      state[side] = sides[side].value;
      draw();
    });
  }
  for (const radio of document.querySelectorAll("input[name=kind]")) {
    radio.addEventListener("change", () => {
      state.kind = radio.value;
      draw();
    });
  }
  fillSelect(
    driveChoice,
    data.drives.map((_, index) => `:${index}`),
  );
  data.drives.forEach((each, index) => {
    driveChoice.options[index].textContent = each.title;
  });
  find(".drive").hidden = data.drives.length < 2;
  driveChoice.addEventListener("change", () => openDrive(driveChoice.selectedIndex));
  viewer.hidden = false;
  find(".without-script").hidden = true;
  openDrive(0);
})();
