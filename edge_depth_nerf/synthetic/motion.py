"""Where things are at any time: routes on the ground, what moves along them, and the recording car's own motion.

Frames: world (x, y horizontal, z up, metres), pose = vehicle (x forward, y right, z down). Times in seconds;
headings in radians, counter-clockwise from world x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.synthetic.geometry import Geometry, Pair, Real
from edge_depth_nerf.synthetic.rig import POSE_HEIGHT_M

FRAME_INTERVAL_S = 0.1
"""Time between frames, and of one turn of the LiDAR."""

_STEP_M = 0.01
_EASING_M = 3.0
"""Length over which the curvature of a turn goes from 0 to 1/radius, and back."""


@dataclass(frozen=True)
class Turn:
    """A turn of a route."""

    angle_rad: Real
    """Signed: positive to the left."""
    radius_m: Real
    """Its smallest radius."""
    straight_m: Real = 0.0
    """Length of the straight stretch before it."""


class Route:
    """A path on the ground: straight, or straight with one turn whose curvature rises and falls evenly."""

    def __init__(self, start: Pair, heading_rad: float = 0.0, turn: Turn | None = None) -> None:
        """Lay out the route from x, y where the arc length is 0."""
        turn_rad, radius_m = (turn.angle_rad, turn.radius_m) if turn else (0.0, 1.0)
        self._start, self._heading = np.asarray(start, np.float64), heading_rad
        self._turn, self._turn_at = turn_rad, turn.straight_m if turn else np.inf
        self.turn_length_m = abs(turn_rad) * radius_m + _EASING_M if turn else 0.0
        """Arc length of the turn with its easing."""
        s = np.arange(0, self.turn_length_m + _STEP_M, _STEP_M)
        curvature = np.minimum(1, np.minimum(s, self.turn_length_m - s).clip(0) / _EASING_M) / radius_m
        # middle of each step, so that the sums are second-order accurate
        turned = np.concatenate(([0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * _STEP_M)))
        turned = np.sign(turn_rad) * turned * (abs(turn_rad) / turned[-1] if turn_rad else 0.0)
        middle = heading_rad + (turned[1:] + turned[:-1]) / 2
        steps = np.stack((np.cos(middle), np.sin(middle)), -1) * _STEP_M
        self._turn_s, self._turned = s, turned
        self._turn_path = np.concatenate((np.zeros((1, 2)), np.cumsum(steps, axis=0)))

    def at(self, s_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (N×2) and headings (N) at N arc lengths, which may lie before the start."""
        s = np.asarray(s_m, np.float64)
        before = np.minimum(s, self._turn_at)
        inside = np.clip(s - self._turn_at, 0, self._turn_s[-1])
        after = np.maximum(s - self._turn_at - self._turn_s[-1], 0)
        turned = np.interp(inside, self._turn_s, self._turned)
        bend = np.stack([np.interp(inside, self._turn_s, self._turn_path[:, axis]) for axis in (0, 1)], -1)
        first = np.array((np.cos(self._heading), np.sin(self._heading)))
        last = np.array((np.cos(self._heading + self._turn), np.sin(self._heading + self._turn)))
        return self._start + before[..., None] * first + bend + after[..., None] * last, self._heading + turned


class WindingRoute:
    """A path on the ground with several turns, one behind the other, as smooth as a `Route`."""

    def __init__(self, start: Pair, heading_rad: float, turns: Sequence[Turn]) -> None:
        """Lay out the route from where its arc length is 0; behind the last turn it is straight."""
        self._legs: list[Route] = []
        self.ends_m: list[float] = []
        """Arc lengths where the turns end."""
        place, heading, passed = start, heading_rad, 0.0
        for turn in turns:
            leg = Route(place, heading, turn)
            length = float(turn.straight_m) + leg.turn_length_m
            places, headings = leg.at(np.array([length]))
            place, heading, passed = (float(places[0, 0]), float(places[0, 1])), float(headings[0]), passed + length
            self._legs.append(leg)
            self.ends_m.append(passed)

    def at(self, s_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (N×2) and headings (N) at N arc lengths, which may lie before the start."""
        s = np.asarray(s_m, np.float64)
        leg_of = np.searchsorted(self.ends_m[:-1], s)
        position, heading = np.empty((*s.shape, 2)), np.empty(s.shape)
        for number, (leg, begin) in enumerate(zip(self._legs, (0.0, *self.ends_m), strict=False)):
            own = leg_of == number
            position[own], heading[own] = leg.at(s[own] - begin)
        return position, heading


@dataclass(frozen=True)
class Drive:
    """The recording car's motion: along a route at an uneven speed, swaying, pitching and rolling a little."""

    route: Route | WindingRoute
    start_m: float
    """Arc length at time 0."""
    speed_m_s: float
    """Mean speed."""
    phases: NDArray[np.float64]
    """Five phases in radians: speed, sway, pitch, roll, bounce."""

    @staticmethod
    def random(route: Route | WindingRoute, start_m: float, speed_m_s: float, rng: Generator) -> Drive:
        """A drive whose disturbances have random phases."""
        return Drive(route, start_m, speed_m_s, rng.uniform(0, 2 * np.pi, 5))

    def pose_to_world(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """The vehicle's poses at N times, N×4×4."""
        t = np.asarray(time_s, np.float64)
        phase = self.phases
        rate = 2 * np.pi / 3.1
        uneven = 0.06 * (np.cos(phase[0]) - np.cos(rate * t + phase[0])) / rate
        s = self.start_m + self.speed_m_s * (t + uneven)
        position, heading = self.route.at(s)
        sway, sway_rate = 0.10, 2 * np.pi / 23
        left = np.stack((-np.sin(heading), np.cos(heading)), -1)
        position = position + (sway * np.sin(sway_rate * s + phase[1]))[..., None] * left
        heading = heading + np.arctan(sway * sway_rate * np.cos(sway_rate * s + phase[1]))
        pitch = np.deg2rad(0.35) * np.sin(2 * np.pi * t / 1.3 + phase[2])
        roll = np.deg2rad(0.5) * np.sin(2 * np.pi * t / 1.7 + phase[3])
        height = POSE_HEIGHT_M + 0.01 * np.sin(2 * np.pi * t / 1.1 + phase[4])
        ch, sh, cp, sp, cr, sr = (f(a) for a in (heading, pitch, roll) for f in (np.cos, np.sin))
        # turning by heading, then pitch, then roll; the pose's y and z axes point right and down
        forward = np.stack((ch * cp, sh * cp, sp), -1)
        left = np.stack((-sh * cr - ch * sp * sr, ch * cr - sh * sp * sr, cp * sr), -1)
        rotation = np.stack((forward, -left, np.cross(forward, -left)), -1)
        return rigid(rotation, np.concatenate((position, height[..., None]), -1))


@dataclass(frozen=True)
class Mover:
    """A car, a person or another thing that moves along a route at one speed, and may stand for a while."""

    geometry: Geometry
    route: Route | WindingRoute
    start_m: Real
    """Arc length at time 0."""
    speed_m_s: Real
    stands_s: Pair | None = None
    """From when until when it stands; None = never. It loses its speed in the second before, and has it again a second
    after."""
    ground_m: Real = 0.0
    """Height of the ground that it moves on."""

    def at(self, time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions on the ground (N×2) and headings (N) at N times."""
        driven_s = np.asarray(time_s, np.float64)
        if self.stands_s is not None:
            begin, end = self.stands_s
            # the time that would have taken as far at full speed: half of each second of braking and of starting
            braking, starting = np.clip(driven_s - (begin - 1), 0, 1), np.clip(driven_s - end, 0, 1)
            before = np.minimum(driven_s, begin - 1) + braking - braking**2 / 2
            driven_s = before + starting**2 / 2 + np.maximum(driven_s - (end + 1), 0)
        return self.route.at(self.start_m + self.speed_m_s * driven_s)
