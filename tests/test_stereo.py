"""Distance from motion on scenes whose distances follow from a formula."""

import math

import cv2
import numpy as np
import pytest
import torch
from balls import FISHEYE, THETA_MAX_RAD, in_ball, pose, texture
from lenses import IMAGE_02, IMAGE_03

from edge_depth_nerf.cameras import Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.projection_series import WRONG_PX, projection_series
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.stereo import sphere_sweep
from edge_depth_nerf.stereo.consistency import (
    LEAST_AGREEING,
    LEAST_CONFIDENCE,
    LEAST_PARALLAX_PX,
    MotionDistance,
    confirm,
    seen_around,
)
from edge_depth_nerf.stereo.motion import Motion
from edge_depth_nerf.stereo.sweep import (
    NEAREST_M,
    STEP_PX,
    STEP_SHARE,
    Swept,
    geometry_of,
    hypotheses,
    rays_of,
    sweep_view,
)
from edge_depth_nerf.stereo.views import MOST_PIXELS, View, choose_neighbours, nearest_views, view_of, working_factor

WALL = Pinhole(110, 80, 70.0, 70.0, 55.0, 40.0)
STEPS = (0.0, 0.3, 0.6, 0.9, 1.2)
MIDDLE = 2


def of_wall(camera: Camera, to_world: np.ndarray, contrast: float = 1.0) -> tuple[View, np.ndarray]:
    """A view of a wall 5 m ahead of the world's origin that runs away to the right, and its true distances."""
    normal, offset_m = np.array([0.5, 0.0, 1.0]) / math.sqrt(1.25), 5.0 / math.sqrt(1.25)
    world = rays(camera).directions.astype(np.float64) @ to_world[:3, :3].T
    distance = (offset_m - to_world[:3, 3] @ normal) / (world @ normal)
    points = to_world[:3, 3] + distance[..., None] * world
    noise = np.random.default_rng(int(1000 * (10 + to_world[0, 3]))).normal(0, 1, distance.shape)
    grey = 120 + contrast * (texture(points, (0.3, 0.9)) - 120) + noise
    return View(np.rint(grey).astype(np.float32), camera, to_world), distance


def found(views: list[View], index: int = MIDDLE) -> MotionDistance:
    motion = Motion(
        np.stack([view.camera_to_world[:3, 3] for view in views]), ["only"] * len(views), lambda number: views[number]
    )
    return motion.confirm(index, motion.sweep)


def other_grey(view: View, grey: np.ndarray) -> View:
    return View(grey.astype(np.float32), view.camera, view.camera_to_world, view.theta_max_rad)


def errors(distance: MotionDistance, truth_m: np.ndarray) -> np.ndarray:
    kept = distance.distance_m > 0
    assert kept.any()
    return np.abs(distance.distance_m - truth_m)[kept] / truth_m[kept]


@pytest.fixture(scope="module")
def balls() -> list[tuple[View, np.ndarray]]:
    return [in_ball(FISHEYE, pose(x, 0.1 * x, 0.05, 0.1 * x)) for x in STEPS]


@pytest.fixture(scope="module")
def ball(balls) -> tuple[list[View], np.ndarray]:
    return [view for view, _ in balls], balls[MIDDLE][1]


@pytest.fixture(scope="module")
def wall() -> list[View]:
    return [of_wall(WALL, pose(x))[0] for x in STEPS]


@pytest.fixture(scope="module")
def of_ball(ball) -> MotionDistance:
    return found(ball[0])


def test_neighbours_distances_are_seen_where_they_lie(balls, ball):
    views, truth = ball
    others = [number for number in range(len(STEPS)) if number != MIDDLE]
    theirs = [np.where(views[number].used, balls[number][1], 0).astype(np.float32) for number in others]
    # one of four is wrong
    theirs[0] = 0.5 * theirs[0]
    seen_m = seen_around(views[MIDDLE], [views[number] for number in others], theirs)
    kept = seen_m > 0
    assert kept[views[MIDDLE].used].mean() > 0.9 and not kept[~views[MIDDLE].used].any()
    error = np.abs(seen_m - truth)[kept] / truth[kept]
    assert np.median(error) < 0.01 and np.mean(error < 0.1) > 0.9
    nothing = [np.zeros_like(each) for each in theirs]
    assert not seen_around(views[MIDDLE], [views[number] for number in others], nothing).any()


def test_what_a_near_thing_hides_is_not_seen():
    # a wall at 5 m and a board at 2 m before its middle, both known from beside
    view, beside = (View(np.full((80, 110), 100, np.float32), WALL, place) for place in (pose(0.0), pose(0.3)))

    def scene_m(position_x: float) -> np.ndarray:
        x, y, z = np.moveaxis(rays(WALL).directions, -1, 0)
        on_board = (np.abs(position_x + 2 * x / z) < 0.5) & (np.abs(2 * y / z) < 0.5)
        return np.where(on_board, 2 / z, 5 / z).astype(np.float32)

    seen_m, truth = seen_around(view, [beside], [scene_m(0.3)]), scene_m(0.0)
    board = cv2.erode((truth < 3).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert board.sum() > 300 and (seen_m[board] > 0).mean() > 0.7
    np.testing.assert_allclose(seen_m[board & (seen_m > 0)], truth[board & (seen_m > 0)], rtol=0.02)


# ---- lenses ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("camera", "theta_max_deg"),
    [
        (FISHEYE, 105),
        (IMAGE_02.downscaled(4), 95),
        (IMAGE_03.downscaled(4), 105),
        (Pinhole(704, 188, 276.0, 276.0, 341.0, 119.0, 0.05, -0.02, 1e-3, -2e-3), 180),
        (KannalaBrandt(350, 350, 104.0, 104.0, 179.0, 177.0, -0.01, 0.01, -0.002, -3e-4, 1e-4, 1e-4), 95),
    ],
)
def test_series_projects_as_the_lens_does(camera, theta_max_deg):
    theta_max_rad = math.radians(theta_max_deg)
    seen = rays(camera, theta_max_rad)
    series = projection_series(camera, theta_max_rad)
    at, within = seen.directions[seen.within].T.copy(), int(seen.within.sum())
    work = np.empty((8, within), np.float32)
    turn, shift = np.eye(3, dtype=np.float32), np.array([0.1, -0.2, 0.05], np.float32)
    nearness = np.full(within, 0.5, np.float32)
    sphere_sweep._project_row(at, nearness, turn, shift, series.factors, series.numbers, work)
    column, row, length = work[5:]
    points = at.T.astype(np.float64) + 0.5 * shift
    expected, valid = camera.project(torch.from_numpy(points))
    reached = (column != -1) & valid.numpy()
    assert reached.mean() > 0.9
    off = np.hypot(column + 0.5 - expected[:, 0].numpy(), row + 0.5 - expected[:, 1].numpy())[reached]
    assert off.max() < 2 * WRONG_PX
    np.testing.assert_allclose(length, np.linalg.norm(points, axis=1), rtol=1e-5)


def test_beyond_the_lens_nothing_is_projected():
    series = projection_series(FISHEYE, THETA_MAX_RAD)
    at = np.array([[math.sin(2.2), 0.0, math.cos(2.2)], [0.0, 0.0, 1.0]], np.float32).T.copy()
    turn, shift, work = np.eye(3, dtype=np.float32), np.zeros(3, np.float32), np.empty((8, 2), np.float32)
    sphere_sweep._project_row(at, np.zeros(2, np.float32), turn, shift, series.factors, series.numbers, work)
    assert work[5, 0] == -1
    assert work[5, 1] == pytest.approx(FISHEYE.cx - 0.5, abs=1e-3)


# ---- the loops against slow twins ------------------------------------------------------------------------------
def slow_cost(view: View, neighbours: list[View], inverse_per_m: float, noise: float) -> np.ndarray:
    """1 - the mean correlation of the best half, in float64, window by window."""
    height, width = view.grey.shape
    warped = []
    for neighbour in neighbours:
        relative = np.linalg.inv(neighbour.camera_to_world) @ view.camera_to_world
        points = view.rays.directions.astype(np.float64) @ relative[:3, :3].T + inverse_per_m * relative[:3, 3]
        pixels, valid = neighbour.camera.project(torch.from_numpy(points))
        x, y = (torch.nan_to_num(pixels) - 0.5).numpy().reshape(-1, 2).T.reshape(2, height, width)
        ok = valid.numpy() & (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
        j, i = (np.where(ok, np.floor(each), 0).astype(int) for each in (x, y))
        a, b = x - j, y - i
        grey = neighbour.grey.astype(np.float64)
        upper, lower = ((1 - a) * grey[row, j] + a * grey[row, j + 1] for row in (i, i + 1))
        warped.append(np.where(ok, (1 - b) * upper + b * lower, np.nan))
    cost = np.ones((height, width))
    for i in range(2, height - 2):
        for j in range(2, width - 2):
            window = (slice(i - 2, i + 3), slice(j - 2, j + 3))
            mine = view.grey[window].astype(np.float64)
            values = []
            for picture in warped:
                theirs = picture[window]
                covariance = ((mine - mine.mean()) * (theirs - theirs.mean())).mean()
                values.append(covariance / math.sqrt((mine.var() + noise) * (theirs.var() + noise)))
            values = sorted((value for value in values if not math.isnan(value)), reverse=True)
            if values and not np.isnan(mine).any():
                half = (len(values) + 1) // 2
                cost[i, j] = 1 - sum(max(value, 0) for value in values[:half]) / half
    return cost


def test_sweep_is_its_slow_twin():
    small = KannalaBrandt(30, 28, 8.0, 8.0, 15.1, 13.8, 0.01, -0.002, 0.0, 0.0)
    views = [in_ball(small, pose(x, 0.1, 0.2 * x, 0.3 * x))[0] for x in (0.0, 0.4, -0.5, 0.9)]
    view, neighbours = views[0], views[1:]
    view.grey[10:13, 4:6] = np.nan
    used = view.used
    spans = np.stack([used.argmax(1), np.where(used.any(1), 30 - used[:, ::-1].argmax(1), 0)], -1)
    (pictures, transforms), inverses = geometry_of(view, neighbours), np.array([0.0, 0.15, 0.4], np.float32)
    cost = np.empty((28, 3, 30), np.float32)
    sphere_sweep.sweep(*(view.grey, pictures, rays_of(view), spans, *transforms, inverses, np.float32(2.0), cost))
    expected = np.stack([slow_cost(view, neighbours, float(each), 2.0) for each in inverses], 1)
    assert (expected < 1).mean() > 0.3
    # at the rim of a lens a rounding decides who sees a pixel
    off = np.abs(cost - expected)
    assert np.quantile(off, 0.99) < 2e-3
    assert (off > 0.05).mean() < 5e-3


def slow_paths(cost: np.ndarray, picture: np.ndarray, small: float, large: float, edge: float) -> np.ndarray:
    height, width, count = cost.shape
    total = np.zeros(cost.shape)
    for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        paths = np.zeros(cost.shape)
        order = [(i, j) for i in range(height)[:: di or 1] for j in range(width)[:: dj or 1]]
        for i, j in order:
            if np.isnan(picture[i, j]):
                continue
            y, x = i - di, j - dj
            paths[i, j] = cost[i, j]
            if 0 <= y < height and 0 <= x < width and not np.isnan(picture[y, x]):
                jump = max(small, large / (1 + abs(picture[i, j] - picture[y, x]) / edge))
                before = paths[y, x]
                for d in range(count):
                    beside = [before[other] + small for other in (d - 1, d + 1) if 0 <= other < count]
                    paths[i, j, d] += min(before[d], *beside, before.min() + jump) - before.min()
        total += paths / 8
    return total


def test_aggregation_is_its_slow_twin():
    rng = np.random.default_rng(3)
    cost, picture = rng.random((7, 5, 9)).astype(np.float32), rng.uniform(0, 255, (7, 9)).astype(np.float32)
    picture[2:4, 3] = np.nan
    total = np.empty((7, 9, 5), np.float32)
    sphere_sweep.aggregate(cost, picture, np.float32(0.05), np.float32(0.4), np.float32(20), total)
    expected = slow_paths(cost.transpose(0, 2, 1).astype(np.float64), picture, 0.05, 0.4, 20.0)
    np.testing.assert_allclose(total, expected, atol=2e-6)


# ---- right distances -------------------------------------------------------------------------------------------
def test_distances_in_a_ball_are_right_also_beyond_90_deg(ball, of_ball):
    views, truth = ball
    error = errors(of_ball, truth)
    assert np.median(error) < 0.02
    assert error.mean() < 0.03
    behind = views[MIDDLE].used & (views[MIDDLE].rays.cos_theta < 0)
    kept = of_ball.distance_m > 0
    assert behind.sum() > 500
    assert (kept & behind).sum() > 0.3 * behind.sum()
    assert np.median((np.abs(of_ball.distance_m - truth) / truth)[kept & behind]) < 0.03
    assert kept[views[MIDDLE].used].mean() > 0.6


def test_distances_of_a_slanted_wall_are_right(wall):
    of_middle = found(wall)
    error = errors(of_middle, of_wall(WALL, pose(STEPS[MIDDLE]))[1])
    assert (of_middle.distance_m > 0).mean() > 0.6
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.95) < 0.05


def test_cameras_of_one_frame_measure_as_frames_do():
    places = [pose(0.0), pose(0.5, 0.2), pose(-0.4, -0.3)]
    views = [of_wall(WALL, place) for place in places]
    error = errors(found([view for view, _ in views], 0), views[0][1])
    assert len(error) > 0.5 * WALL.width * WALL.height
    assert np.median(error) < 0.01


def test_confidence_is_said_where_there_is_a_distance_and_nowhere_else(of_ball):
    kept = of_ball.distance_m > 0
    assert (of_ball.confidence[kept] >= LEAST_CONFIDENCE).all() and (of_ball.confidence[kept] <= 1).all()
    assert (of_ball.parallax_px[kept] >= LEAST_PARALLAX_PX).all()
    assert not of_ball.confidence[~kept].any() and not of_ball.parallax_px[~kept].any()


def test_the_doubtful_are_wrong_more_often(ball):
    rng = np.random.default_rng(4)
    views, truth = ball
    # noise as strong as the texture
    of_noisy = found([other_grey(view, view.grey + rng.normal(0, 40, view.grey.shape)) for view in views])
    kept = of_noisy.distance_m > 0
    wrong = np.abs(of_noisy.distance_m - truth) / truth > 0.1
    sure = of_noisy.confidence > np.median(of_noisy.confidence[kept])
    assert kept.sum() > 1000
    assert wrong[kept & sure].mean() < wrong[kept & ~sure].mean()


# ---- no distance is better than a wrong one --------------------------------------------------------------------
def test_along_the_direction_of_travel_there_is_none():
    views = [in_ball(FISHEYE, pose(0.0, 0.0, z)) for z in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    ahead = found([view for view, _ in views])
    # 0.5 m nearer to a wall at 6 m
    theta = np.arccos(np.clip(views[MIDDLE][0].rays.cos_theta, -1, 1))
    used = views[MIDDLE][0].used
    assert not (ahead.distance_m > 0)[used & (theta < math.radians(10))].any()
    assert (ahead.distance_m > 0)[used & (theta > math.radians(60)) & (theta < math.radians(90))].mean() > 0.5
    assert np.median(errors(ahead, views[MIDDLE][1])) < 0.03


def test_standing_still_turning_on_the_spot_and_trembling_give_none():
    for turn_rad in (0.0, 0.2):
        views = [in_ball(FISHEYE, pose(0.5, 0.0, 0.0, turn_rad * number))[0] for number in range(5)]
        assert choose_neighbours(views[MIDDLE], [views[0], views[1], views[3]]) == []
        assert not found(views).distance_m.any()
    shaken = np.random.default_rng(2).normal(0, 0.002, (5, 3))
    views = [in_ball(FISHEYE, pose(x, y, z, 0.1 * number))[0] for number, (x, y, z) in enumerate(shaken)]
    assert not found(views).distance_m.any()


def test_a_wall_without_texture_has_none():
    views = [of_wall(WALL, pose(x), contrast=0.0)[0] for x in STEPS]
    assert (found(views).distance_m > 0).mean() < 0.002


def test_two_pictures_give_none(wall):
    assert not found([wall[0], wall[MIDDLE]], 1).distance_m.any()
    assert found([wall[0], wall[MIDDLE], wall[4]], 1).distance_m.any()


def test_exposure_that_jumps_by_two_stops_changes_little(ball, of_ball):
    views, truth = ball
    of_jumping = found([other_grey(view, np.rint(view.grey / 4)) if n % 2 else view for n, view in enumerate(views)])
    assert (of_jumping.distance_m > 0).sum() > 0.8 * (of_ball.distance_m > 0).sum()
    assert np.median(errors(of_jumping, truth)) < 0.02


def test_pictures_that_show_something_else_give_none(wall):
    rng = np.random.default_rng(5)
    other = [other_grey(view, rng.uniform(0, 255, view.grey.shape)) for view in wall]
    other[MIDDLE] = wall[MIDDLE]
    assert (found(other).distance_m > 0).mean() < 0.005


def test_what_is_masked_takes_no_part(ball):
    views, _ = ball
    hidden = np.zeros(views[0].grey.shape, bool)
    hidden[50:70, 40:60] = True

    def masked(under: float) -> list[View]:
        greys = [np.where(hidden, np.float32(under), view.grey) for view in views]
        usable = [~hidden & view.used for view in views]
        colours = [np.repeat(np.nan_to_num(grey)[..., None], 3, -1).astype(np.uint8) for grey in greys]
        return [
            view_of(colour, use, view.camera, view.camera_to_world, view.theta_max_rad)
            for colour, use, view in zip(colours, usable, views, strict=True)
        ]

    dark, bright = found(masked(0.0)), found(masked(255.0))
    assert (dark.distance_m > 0).sum() > 3000
    assert not dark.distance_m[hidden].any()
    np.testing.assert_array_equal(dark.distance_m, bright.distance_m)


# ---- what confirms a distance ----------------------------------------------------------------------------------
def swept_at(distance_m: np.ndarray) -> Swept:
    shape = distance_m.shape
    good = np.full(shape, 0.9, np.float32)
    return Swept((1 / distance_m).astype(np.float32), good, good, np.full(shape, 20.0, np.float32))


@pytest.mark.parametrize(
    ("factors", "kept"),
    [
        ((1.0, 1.0, 1.0), True),
        ((1.0, 1.0, 1.5), True),  # two have it, one sees through it
        ((1.0, 1.5, 1.5), False),
        ((1.0, 0.5, 0.5), False),  # hidden from two, and one is too few
        ((1.0, 1.0, 0.5), True),
        ((0.0, 0.0, 1.0), False),
        ((1.02, 1.02, 1.0), True),
    ],
)
def test_neighbours_confirm_or_see_through(factors, kept):
    views = [in_ball(FISHEYE, pose(x)) for x in (0.0, 0.2, 0.4, -0.2)]
    theirs = [
        np.where(view.used & (factor > 0), 1 / np.maximum(factor * truth, 1e-6), 0).astype(np.float32)
        for factor, (view, truth) in zip(factors, views[1:], strict=True)
    ]
    view, truth = views[0]
    confirmed = confirm(view, swept_at(truth), [each for each, _ in views[1:]], theirs)
    middle = confirmed.distance_m[45:65, 45:65]
    assert (middle > 0).mean() == pytest.approx(float(kept), abs=0.02)
    if kept:
        # the mean of what agrees
        near = [1 / factor for factor in (1.0, *factors) if abs(factor - 1) < 0.1]
        np.testing.assert_allclose(middle[middle > 0], (truth[45:65, 45:65] / np.mean(near))[middle > 0], rtol=0.01)


def test_too_few_neighbours_confirm_nothing():
    view, truth = in_ball(FISHEYE, pose(0.0))
    others = [in_ball(FISHEYE, pose(x)) for x in (0.2, 0.4)]
    theirs = [np.where(each.used, 1 / distance, 0).astype(np.float32) for each, distance in others]
    assert LEAST_AGREEING == 2
    assert confirm(view, swept_at(truth), [others[0][0]], theirs[:1]).distance_m.max() == 0
    assert (confirm(view, swept_at(truth), [each for each, _ in others], theirs).distance_m > 0).mean() > 0.5


# ---- neighbours and hypotheses ---------------------------------------------------------------------------------
def test_a_stop_leaves_place_for_views_from_elsewhere():
    """Two cameras, side by side, that stand for 40 frames and then drive."""
    along_m = [*np.zeros(40), *np.arange(1, 21) * 0.5]
    positions = np.array([[x, side, 0.0] for x in along_m for side in (0.0, 0.01)])
    cameras = ["left", "right"] * len(along_m)
    near = nearest_views(positions, 0, cameras)
    assert near[:3] == [1, 80, 81] and len(near) == 32
    assert {cameras[view] for view in near} == {"left", "right"} and len({*near}) == 32
    # from the first one behind it, too: of the stop one view of each camera
    assert sum(view < 80 for view in nearest_views(positions, 80, cameras)) == 2


def test_neighbours_lie_on_both_sides_and_see_the_same():
    views = [of_wall(WALL, pose(x))[0] for x in (0.0, 0.3, -0.3, 0.6, -0.6, 0.01)]
    turned = of_wall(WALL, pose(0.4))[0]
    backward = View(turned.grey, WALL, pose(0.4, turn_rad=math.pi))
    others = [*views[1:], backward]
    assert nearest_views(np.array([[0.0, 0, 0], [3, 0, 0], [1, 0, 0]]), 0, ["a"] * 3) == [2, 1]
    two = choose_neighbours(views[0], others, 2)
    assert {others[index].camera_to_world[0, 3] > 0 for index in two} == {True, False}
    everyone = choose_neighbours(views[0], others, 8)
    assert len(others) - 1 not in everyone
    assert len(everyone) >= 4


def test_hypotheses_begin_at_infinity_and_are_as_dense_as_points_move():
    views = [of_wall(WALL, pose(x))[0] for x in (0.0, 0.5)]
    near = hypotheses(views[0], views[1:])
    assert near[0] == 0
    assert near[-1] == pytest.approx(1 / NEAREST_M)
    assert (np.diff(near) > 0).all()
    # far off a step is a pixel: focal length × 0.5 m × change of the inverse distance
    assert 70 * 0.5 * (near[2] - near[1]) == pytest.approx(STEP_PX, rel=0.2)
    # near by, as far as points are seen, it is a share of the distance: at 1.1 m here
    at = int(np.searchsorted(near, 0.9))
    assert np.log(near[at + 1] / near[at]) == pytest.approx(STEP_SHARE, rel=0.1)
    assert len(hypotheses(views[0], [views[0]])) < 3
    assert not sweep_view(views[0], []).inverse_per_m.any()


def test_large_pictures_are_averaged_down():
    camera = FISHEYE.downscaled(1)
    assert working_factor(camera) == 1
    large = KannalaBrandt(1400, 1400, 415.9, 415.7, 717.4, 706.2, -0.01, 0.01, -0.002, -3e-4)
    factor = working_factor(large)
    assert factor == 4
    picture = np.full((1400, 1400, 3), 100, np.uint8)
    picture[:, 1::2] = 140
    usable = np.ones((1400, 1400), bool)
    usable[700, 701] = False
    view = view_of(picture, usable, large, np.eye(4), math.radians(95))
    assert view.grey.shape == (350, 350) and view.grey.size <= MOST_PIXELS
    assert np.isnan(view.grey[175, 175])
    assert view.grey[170, 170] == pytest.approx(120, abs=0.1)
