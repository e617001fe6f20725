from pathlib import Path

import numpy as np
import pytest
import torch

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.plugin import pixel_table
from edge_depth_nerf.plugin.pixel_table import RECORD, PicturePixels, PixelTable, decode, to_steps, write_table


def picture(height, width):
    """Colours that say where they are from: red = row, green = column."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows, columns, np.full_like(rows, 9)], axis=-1).astype(np.uint8)


def table_of(path: Path, masks, priors=None) -> PixelTable:
    given = zip(masks, priors or [()] * len(masks), strict=True)
    pictures = [PicturePixels(picture(*mask.shape), mask, *maps) for mask, maps in given]
    write_table(path, sum(mask.size for mask in masks), pictures)
    return PixelTable(path)


@pytest.mark.parametrize("bucket_bytes", [1 << 20, 200])
def test_every_valid_pixel_comes_once_with_its_own_prior(tmp_path, monkeypatch, bucket_bytes):
    monkeypatch.setattr(pixel_table, "BUCKET_BYTES", bucket_bytes)
    rng = np.random.default_rng(5)
    masks = [rng.random(size) < 0.5 for size in [(4, 7), (9, 3), (4, 7)]]
    priors = []
    for number, mask in enumerate(masks):
        distance = (1 + number + np.arange(mask.size).reshape(mask.shape) / 256).astype(np.float32)
        priors.append((distance, distance / 2))
    table = table_of(tmp_path / "t.npy", masks, priors)
    assert len(table) == sum(mask.sum() for mask in masks)
    assert table.share_with_prior == 1
    batch = table.batch(0, len(table))
    seen = set()
    for (number, row, column), rgb, distance, sigma in zip(
        batch.indices.tolist(), batch.rgb, batch.prior_distance_m, batch.prior_sigma_m, strict=True
    ):
        assert masks[number][row, column]
        assert (rgb * 255).round().tolist() == [row, column, 9]
        assert distance.item() == priors[number][0][row, column]  # a multiple of 1/256 m
        assert abs(sigma.item() - distance.item() / 2) <= 1 / 512 + 1e-6
        seen.add((number, row, column))
    assert len(seen) == len(table)
    # the same pictures give the same order, and nothing else stays behind
    assert torch.equal(table_of(tmp_path / "t.npy", masks, priors).batch(0, len(table)).indices, batch.indices)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t.npy"]


def test_only_so_many_files_are_open(tmp_path, monkeypatch):
    monkeypatch.setattr(pixel_table, "BUCKET_BYTES", 100)
    monkeypatch.setattr(pixel_table, "MOST_BUCKETS", 3)
    opened, made = [], pixel_table.tempfile.TemporaryFile

    def making(**given):
        opened.append(made(**given))
        return opened[-1]

    monkeypatch.setattr(pixel_table.tempfile, "TemporaryFile", making)
    table = table_of(tmp_path / "t.npy", [np.ones((20, 30), bool)])
    assert len(opened) == 3 and all(file.closed for file in opened)
    assert len({*map(tuple, table.batch(0, 600).indices.tolist())}) == 600


def test_after_the_last_pixel_comes_the_first(tmp_path):
    table = table_of(tmp_path / "t.npy", [np.ones((5, 6), bool)])
    whole = table.batch(0, 30).indices
    np.testing.assert_array_equal(table.batch(25, 8).indices, whole[[25, 26, 27, 28, 29, 0, 1, 2]])
    np.testing.assert_array_equal(table.batch(30 * 7 + 3, 4).indices, whole[3:7])
    # a batch larger than the table
    assert np.bincount(table.batch(4, 70).indices[:, 1] * 6 + table.batch(4, 70).indices[:, 2]).min() == 2


@pytest.mark.parametrize("bucket_bytes", [1 << 20, 1000])
def test_the_order_is_random(tmp_path, monkeypatch, bucket_bytes):
    """Wherever one looks, the batch is a fair sample of pictures and places."""
    monkeypatch.setattr(pixel_table, "BUCKET_BYTES", bucket_bytes)
    table = table_of(tmp_path / "t.npy", [np.ones((60, 60), bool), np.ones((20, 20), bool)])
    shares, rows = [], []
    for start in range(0, 4000, 400):
        indices = table.batch(start, 400).indices
        shares.append((indices[:, 0] == 0).float().mean())
        rows.append(indices[indices[:, 0] == 0][:, 1].float().mean())
    # 3600 of 4000 pixels; standard deviations of a sample of 400: 0.015 and 0.91
    assert np.abs(np.array(shares) - 0.9).max() < 0.06 and np.std(shares) > 0.003
    assert np.abs(np.array(rows) - 29.5).max() < 4 and np.std(rows) > 0.2
    together = table.batch(0, 4000).indices.numpy() @ [3600, 60, 1]
    neighbours = np.corrcoef(together[:-1], together[1:])[0, 1]
    assert abs(neighbours) < 0.06  # standard deviation 0.016


def test_pictures_without_valid_pixels_are_never_drawn(tmp_path):
    masks = [np.zeros((3, 3), bool), np.eye(3, dtype=bool), np.zeros((3, 3), bool)]
    table = table_of(tmp_path / "t.npy", masks)
    assert table.share_with_prior == 0
    assert set(table.batch(0, 100).indices[:, 0].tolist()) == {1}


def test_no_valid_pixel_at_all(tmp_path):
    with pytest.raises(InputError, match="inverted"):
        table_of(tmp_path / "t.npy", [np.zeros((2, 2), bool)])
    assert not list(tmp_path.iterdir())


def test_what_16_bits_cannot_hold_is_no_prior_and_no_sky(tmp_path):
    metres = np.array([0, 1, 255.996, 256.0, np.nan, np.inf, -3, 1 / 256])
    assert to_steps(metres).tolist() == [0, 256, 65535, 0, 0, 0, 0, 1]
    distance = np.array([[255.99, 256.0, 300.0, np.inf, 5.0, 0.001, 0.0, 5.0, 5.0]], np.float32)
    sigma = np.array([[256.0, 300.0, 256.0, np.inf, 1e6, 1000.0, 500.0, 1e-4, 0.0]], np.float32)
    mask = np.ones(distance.shape, bool)
    table = table_of(tmp_path / "t.npy", [mask], [(distance, sigma)])
    batch = table.batch(0, 9)
    in_order = batch.indices[:, 2].argsort()
    assert not batch.sky.any()
    assert (batch.prior_distance_m[in_order, 0] > 0).tolist() == [each in (0, 4, 7, 8) for each in range(9)]
    most = 65535 / 256
    assert batch.prior_sigma_m[in_order, 0].tolist() == [most, 0, 0, 0, most, 0, 0, 1 / 256, 0]
    # where the sky is known it stays known
    batch = table_of(tmp_path / "sky.npy", [mask], [(distance, sigma, np.arange(9)[None] == 2)]).batch(0, 9)
    assert torch.equal(batch.sky[:, 0], batch.indices[:, 2] == 2)


def test_what_is_not_whole_does_not_open(tmp_path, monkeypatch):
    path = tmp_path / "t.npy"
    table_of(path, [np.ones((8, 8), bool)])
    whole = path.read_bytes()

    path.write_bytes(whole[:-15])
    with pytest.raises(InputError, match="changed"):
        PixelTable(path)
    path.write_bytes(whole)
    assert len(PixelTable(path)) == 64
    monkeypatch.setattr(pixel_table, "TABLE_VERSION", pixel_table.TABLE_VERSION + 1)
    with pytest.raises(InputError, match="of another version"):
        PixelTable(path)
    path.unlink()
    with pytest.raises(InputError, match="missing"):
        PixelTable(path)


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    def pictures():
        yield PicturePixels(picture(8, 8), np.ones((8, 8), bool))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_table(tmp_path / "t.npy", 64, pictures())
    assert not list(tmp_path.iterdir())


def test_the_sky_is_known_where_there_is_no_prior(tmp_path):
    distance, sky = np.zeros((6, 7), np.float32), np.zeros((6, 7), bool)
    distance[3:], sky[:4] = 5.0, True
    table = table_of(tmp_path / "t.npy", [np.ones((6, 7), bool)], [(distance, distance / 10, sky)])
    batch = table.batch(0, 42)
    rows = batch.indices[:, 1]
    assert table.share_with_prior == 0.5
    assert torch.equal(batch.sky[:, 0], rows < 3)  # a distance says more than the colour of the sky
    assert torch.equal(batch.prior_sigma_m[:, 0] > 0, rows >= 3)
    chosen = batch.where(batch.sky[:, 0])
    assert torch.equal(chosen.indices, batch.indices[rows < 3]) and chosen.sky.all()


def test_packed_records_are_unpacked_to_what_their_fields_hold():
    rng = np.random.default_rng(3)
    records = np.frombuffer(rng.bytes(500 * RECORD.itemsize), RECORD).copy()
    records["picture"] %= 1 << 31  # pyrefly: ignore[unsupported-operation]
    # the sky, a large sigma with a distance, no prior, and the ends of what the fields hold
    records["distance"][:40], records["sigma"][:20] = 0, 65535
    records["sigma"][20:40], records["distance"][40:60], records["sigma"][40:80] = 0, 65535, 65535
    records["picture"][:9], records["row"][:9], records["column"][:9] = [0, 1, 65535, 65536] + [2**31 - 1] * 5, 65535, 0
    sky = (records["distance"] == 0) & (records["sigma"] == 65535)
    expected = {
        "indices": np.stack([records[name].astype(np.int64) for name in ("picture", "row", "column")], 1),
        "rgb": records["rgb"].astype(np.float32) / 255,
        "prior_distance_m": records["distance"].astype(np.float32)[:, None] / 256,
        "prior_sigma_m": np.where(sky, 0, records["sigma"].astype(np.float32) / 256)[:, None].astype(np.float32),
        "sky": sky[:, None],
    }
    found = decode(torch.from_numpy(records.view(np.uint8).reshape(-1, RECORD.itemsize)))
    assert sky.sum() == 20
    for name, value in expected.items():
        assert torch.equal(getattr(found, name), torch.from_numpy(value)), name
        assert getattr(found, name).numpy().dtype == value.dtype, name


def test_the_share_with_a_prior(tmp_path):
    mask = np.ones((100, 100), bool)
    distance = np.where(np.arange(100) < 50, 5.0, 0.0).astype(np.float32) * np.ones((100, 1), np.float32)
    table = table_of(tmp_path / "t.npy", [mask], [(distance, distance / 10)])
    assert table.share_with_prior == 0.5
    places = table.batch(0, len(table)).indices[:, 1:].numpy() @ [100, 1]
    assert len(np.unique(places)) == 10_000


def test_steps_of_a_quarter_of_a_centimetre():
    metres = np.array([0, 1, 255.996, 256.0, np.nan, np.inf, -3, 1 / 256])
    assert to_steps(metres).tolist() == [0, 256, 65535, 0, 0, 0, 0, 1]


def test_a_sigma_beyond_16_bits_stays_a_sigma(tmp_path):
    distance = np.full((1, 4), 5, np.float32)
    sigma = np.array([[1e-4, 1000.0, 0.5, 0.0]], np.float32)
    batch = table_of(tmp_path / "t.npy", [np.ones((1, 4), bool)], [(distance, sigma)]).batch(0, 4)
    stored = {int(column): float(s) for (_, _, column), s in zip(batch.indices, batch.prior_sigma_m, strict=True)}
    assert stored == {0: 1 / 256, 1: 65535 / 256, 2: 0.5, 3: 0.0}
