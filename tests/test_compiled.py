from edge_depth_nerf import compiled


def test_it_is_known_whether_kernels_lie_compiled_on_disk(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in ("a", "b")]
    for folder in folders:
        folder.mkdir()
    monkeypatch.setattr(compiled, "_folders", set(folders))
    assert not compiled.compiled_before()
    (folders[0] / "kernel.nbi").touch()
    assert not compiled.compiled_before()  # those of the other folder are still to be compiled
    (folders[1] / "kernel.nbi").touch()
    assert compiled.compiled_before()
    monkeypatch.setattr(compiled, "_folders", set())  # no folder can be written: anew each time
    assert not compiled.compiled_before()
