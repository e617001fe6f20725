import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    load_npy,
    read_distance_png,
    read_image,
    read_json,
    read_mask,
    write_atomically,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)


def test_distance_png_keeps_four_millimetres(tmp_path):
    distance = np.array([[0.0, 1.0, 10.123], [255.99, 256.1, np.nan], [-1, np.inf, 0.001]])
    write_distance_png(tmp_path / "d.png", distance)
    back = read_distance_png(tmp_path / "d.png")
    assert back.dtype == np.float32
    # 10.123 m · 256 = 2591.49 -> 2591 steps; what is out of range, NaN or not positive is no value;
    # a positive value below half a step is one step
    assert back.tolist() == [[0, 1, 2591 / 256], [65533 / 256, 0, 0], [0, 0, 1 / 256]]


def test_other_units(tmp_path):
    write_png(tmp_path / "mm.png", np.array([[1500, 0]], np.uint16))
    assert read_distance_png(tmp_path / "mm.png", 1e-3) == pytest.approx(np.array([[1.5, 0]]))


@pytest.mark.parametrize("image", [np.zeros((3, 3), np.uint8), np.zeros((3, 3, 3), np.uint8)])
def test_a_distance_png_must_have_16_bits(tmp_path, image):
    write_png(tmp_path / "d.png", image)
    with pytest.raises(InputError, match=r"d\.png.*16-bit.*uint8"):
        read_distance_png(tmp_path / "d.png")


def test_colours_are_rgb_and_masks_stay(tmp_path):
    red = np.zeros((2, 2, 3), np.uint8)
    red[..., 0] = 200
    write_png(tmp_path / "red.png", red)
    assert np.array_equal(read_image(tmp_path / "red.png"), red)
    assert cv2.imread(str(tmp_path / "red.png"))[0, 0].tolist() == [0, 0, 200]
    write_mask(tmp_path / "m.png", np.eye(4, dtype=bool))
    assert np.array_equal(read_mask(tmp_path / "m.png"), np.eye(4, dtype=bool))


@pytest.mark.parametrize("read", [read_image, read_mask, read_distance_png])
@pytest.mark.parametrize("keep", [0, 30, -20])
def test_a_truncated_png_is_named(tmp_path, read, keep):
    path = tmp_path / "cut.png"
    write_png(path, np.random.default_rng(0).integers(0, 60000, (40, 40)).astype(np.uint16))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"cut\.png.*truncated"):
        read(path)


def test_missing_and_broken_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.png"):
        read_image(tmp_path / "nothing.png")
    with pytest.raises(FileNotFoundError, match=r"nothing\.json"):
        read_json(tmp_path / "nothing.json")
    (tmp_path / "broken.json").write_text('{\n"a": 1,\n}')
    with pytest.raises(InputError, match=r"broken\.json.*line 3"):
        read_json(tmp_path / "broken.json")
    with pytest.raises(ValueError, match="Out of range"):
        write_json(tmp_path / "nan.json", {"x": float("nan")})
    assert not (tmp_path / "nan.json").exists()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def fail(temporary):
        temporary.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_arrays_are_parsed_by_one_thread_at_a_time(tmp_path, monkeypatch):
    """NumPy's header goes through ast.parse, which fails in some Pythons where another thread parses as well."""
    path, inside, most, load = tmp_path / "a.npy", [], [], np.load
    np.save(path, np.arange(3))

    def watched(*arguments, **options):
        inside.append(0)
        most.append(len(inside))
        time.sleep(0.01)
        try:
            return load(*arguments, **options)
        finally:
            inside.pop()

    monkeypatch.setattr(np, "load", watched)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(load_npy, [path] * 4))
    assert [array.tolist() for array in found] == [[0, 1, 2]] * 4
    assert most == [1] * 4
