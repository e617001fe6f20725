import dataclasses

import numpy as np
import pytest

from edge_depth_nerf import prior as prior_module
from edge_depth_nerf.integration import IntegrationOptions
from edge_depth_nerf.prior import PriorCache, PriorOptions, make_prior

RNG = np.random.default_rng(2)


def maps(height=12, width=10):
    mono = (5 + RNG.random((height, width))).astype(np.float32)
    lidar = np.where(RNG.random((height, width)) < 0.3, mono * 1.05, 0).astype(np.float32)
    mask = RNG.random((height, width)) < 0.8
    return lidar, mono, mask


def test_a_prior_is_where_the_mask_is():
    lidar, mono, mask = maps()
    prior = make_prior(lidar, mono, mask, PriorOptions())
    assert np.array_equal(prior.distance_m > 0, mask)
    assert np.array_equal(prior.sigma_m > 0, mask)
    assert (prior.distance_m[mask] > 4.9).all() and (prior.distance_m[mask] < 6.4).all()


def test_lidar_alone_is_lidar_and_mono_alone_is_mono():
    lidar, mono, mask = maps()
    only_lidar = make_prior(lidar, None, mask, PriorOptions(depth_source="lidar"))
    assert np.array_equal(only_lidar.distance_m, lidar * mask)
    assert np.allclose(only_lidar.sigma_m[only_lidar.distance_m > 0], 0.05)
    only_mono = make_prior(None, mono, mask, PriorOptions(depth_source="mono"))
    assert np.array_equal(only_mono.distance_m, mono * mask)
    # a tenth of the distance and 5 cm: sqrt((0.1 * 5.5)^2 + 0.05^2) = 0.552 for 5.5 m
    assert np.allclose(only_mono.sigma_m[mask], np.sqrt((0.1 * mono[mask]) ** 2 + 0.05**2))


def test_the_cache_gives_what_was_made_and_does_not_make_it_again(tmp_path, monkeypatch):
    lidar, mono, mask = maps()
    cache = PriorCache(tmp_path / "cache", PriorOptions())
    first = cache.prior(lidar, mono, mask)
    (file,) = (tmp_path / "cache").iterdir()
    monkeypatch.setattr(prior_module, "make_prior", lambda *_: pytest.fail("made again"))
    second = PriorCache(tmp_path / "cache", PriorOptions()).prior(lidar, mono, mask)
    assert np.array_equal(first.distance_m, second.distance_m)
    assert np.array_equal(first.sigma_m, second.sigma_m)
    assert file.suffix == ".npz"


@pytest.mark.parametrize("change", ["lidar", "mono", "mask", "options"])
def test_whatever_changes_makes_another_file(tmp_path, change):
    lidar, mono, mask = maps()
    options = PriorOptions()
    PriorCache(tmp_path, options).prior(lidar, mono, mask)
    if change == "options":
        options = dataclasses.replace(options, integration=IntegrationOptions(alpha=0.6))
    else:
        changed = {"lidar": lidar, "mono": mono, "mask": mask}[change]
        changed[3, 4] = not changed[3, 4] if change == "mask" else changed[3, 4] + 1
    again = PriorCache(tmp_path, options).prior(lidar, mono, mask)
    assert len(list(tmp_path.iterdir())) == 2
    assert np.array_equal(again.distance_m, make_prior(lidar, mono, mask, options).distance_m)


@pytest.mark.parametrize("damage", ["truncated", "empty", "another shape", "garbage"])
def test_a_damaged_file_is_made_anew(tmp_path, damage):
    lidar, mono, mask = maps()
    cache = PriorCache(tmp_path, PriorOptions())
    good = cache.prior(lidar, mono, mask)
    (file,) = tmp_path.iterdir()
    if damage == "another shape":
        np.savez(file, distance_m=np.zeros((2, 2), np.float32), sigma_m=np.zeros((2, 2), np.float32))
    else:
        content = file.read_bytes()
        file.write_bytes({"truncated": content[:200], "empty": b"", "garbage": b"x" * 500}[damage])
    assert np.array_equal(cache.prior(lidar, mono, mask).distance_m, good.distance_m)
    assert np.array_equal(cache.prior(lidar, mono, mask).sigma_m, good.sigma_m)


def test_a_folder_that_cannot_be_made_is_no_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    lidar, mono, mask = maps()
    prior = PriorCache(tmp_path / "file" / "cache", PriorOptions()).prior(lidar, mono, mask)
    assert (prior.distance_m > 0).any()
