"""Configurations of compared methods, field by field, and what departs from the paper's protocol."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pytest
from comparisons import differing, fake, resolved

from edge_depth_nerf.compare.configuration import (
    REGISTERED,
    configuration,
    described,
    flattened,
    literal_form,
    setting_of,
)
from edge_depth_nerf.compare.methods import (
    METHODS,
    SIGMA_FIELDS,
    WITHOUT_EXTRAS,
    Method,
    MethodName,
    default_methods,
)
from edge_depth_nerf.compare.protocol import departures
from edge_depth_nerf.compare.results import Results
from edge_depth_nerf.compare.specification import OF_A_MACHINE, OF_A_RUN, RunSpecification
from edge_depth_nerf.compare.tables import fields_table
from edge_depth_nerf.plugin.config import make_specifications, read_method_file

LOSS, SOURCE = "pipeline.model.depth_loss", "pipeline.datamanager.depth_source"
PRIOR = "pipeline.datamanager.prior."
EXPOSURE, SHARP = "pipeline.model.exposure", "pipeline.model.depth_loss_sharp"
EXTRAS = {
    "pipeline.model.surface_loss_mult",
    "pipeline.datamanager.surface_rays_per_batch",
    "pipeline.model.sky_loss_mult",
    "pipeline.model.sky_background",
    "pipeline.model.depth_loss_final",
}
LAMBDA, KERNEL = LOSS + "_mult", PRIOR + "integration.kernel"
PAPER = {
    LAMBDA,
    "pipeline.model.depth_loss_levels",
    "pipeline.model.losses.edge.gaussian",
    "pipeline.model.losses.edge.divide_by_norm",
    PRIOR + "align",
    PRIOR + "sigma_mode",
    PRIOR + "sigma_constant_m",
    PRIOR + "motion",
    PRIOR + "integration.sigma_depth_growth_per_m",
    PRIOR + "integration.normalise",
    PRIOR + "integration.keep_returns",
}
"""What the paper says of the prior and of Eq. 4, and λ and σ; exposure is none of it."""


def allowed(method: Method) -> set[str]:
    """What a method may have otherwise than `edge`."""
    of_loss = {"none": {LAMBDA} if method.extras else {LOSS}, "edge": set()}
    return {
        *{"": (), "paper": PAPER, "embedding": {EXPOSURE}, "sharp": {SHARP}}[method.variant],
        *(() if method.extras else EXTRAS),
        *{"integrated": set(), "gaussian": {KERNEL}}.get(method.prior or "", {SOURCE}),
        *of_loss.get(method.loss, {LOSS, LAMBDA, SIGMA_FIELDS.get(method.loss, "")}),
    }


@pytest.mark.parametrize("preset", ["lite", "full", "paper"])
def test_configurations_differ_in_the_named_fields_alone(preset):
    ours = resolved("edge", preset)
    assert len(ours) > 100 and len(METHODS) > 5
    for name, method in METHODS.items():
        other = resolved(name, preset)
        assert set(ours) == set(other) and set(differing(ours, other)) <= allowed(method), name


def test_methods_say_which_extras_they_go_without():
    """That a model would ignore an extra is no word on it."""
    assert {*WITHOUT_EXTRAS} == EXTRAS
    for method in ("nerfacto", "nerfacto-embedding", "urban-nerf", "urban-nerf-los", "ds-nerf", "edge-paper"):
        found = resolved(method)
        assert {name: found[name] for name in EXTRAS} == WITHOUT_EXTRAS, method
    ours = resolved("edge")
    assert not [name for name in EXTRAS if ours[name] == WITHOUT_EXTRAS[name]]


@pytest.mark.parametrize("preset", ["lite", "paper"])
def test_the_table_shows_each_field_in_which_methods_differ(preset):
    """Against the configurations themselves, value by value, for each pair of methods."""
    names: list[MethodName] = [name for name in METHODS if not (preset == "paper" and name.startswith("edge-paper"))]
    runs, values = [], {}
    for name in names:
        specification = RunSpecification("/scenes/a", "", preset, name, 0, 10)
        config, _ = configuration(specification, Path(f"/out/a/{name}_seed-0"))
        run = fake("a", name, 0)
        run.content["configuration"] = described(config)
        runs.append(run)
        values[name] = flattened(config)
    names = Results(runs).methods()
    made = fields_table(Results(runs))
    shown = {row.title: [cell.text() for cell in row.cells] for row in made.rows}
    assert [heading for _, heading in made.headings()] == [METHODS[name].title for name in names]
    pairs: list[tuple[MethodName, MethodName, str]] = [
        (one, other, field)
        for one, other in combinations(names, 2)
        for field in differing(values[one], values[other])
        if field not in OF_A_RUN
    ]
    assert len(pairs) > 50
    for one, other, field in pairs:
        cells = [shown[field][names.index(name)] for name in (one, other)]
        assert cells == [str(values[name][field]) for name in (one, other)]
    assert set(shown) == {field for _, _, field in pairs}
    assert {LOSS, SOURCE} < set(shown)


def test_names_follow_from_loss_prior_and_extras():
    named = {
        "nerfacto": Method("none", None, False),
        "nerfacto-integrated-extras": Method("none", "integrated", True),
        "urban-nerf-los-extras": Method("urban-nerf-los", "lidar", True),
        "ds-nerf-integrated": Method("ds-nerf", "integrated", False),
        "ds-nerf-mono-extras": Method("ds-nerf", "mono", True),
        "edge": Method("edge", "integrated", True),
        "edge-lidar-plain": Method("edge", "lidar", False),
        "edge-paper-gaussian": Method("edge", "gaussian", False, "paper"),
    }
    assert {name: METHODS[name] for name in named} == named
    assert [method.name for method in named.values()] == [*named]
    assert len({method.title for method in METHODS.values()}) == len(METHODS)


def test_each_method_is_what_its_name_says():
    for name, method in METHODS.items():
        found = resolved(name)
        assert found[LOSS] == method.loss or method.loss == "none", name
        assert found[EXPOSURE] == ("embedding" if name == "nerfacto-embedding" else "gain"), name
        if method.prior is not None:
            gaussian = ("integrated", "spatial-gaussian")
            expected = gaussian if method.prior == "gaussian" else (method.prior, "edge-aware")
            assert (found[SOURCE], found[KERNEL]) == expected, name
    assert resolved("nerfacto")[LOSS] == resolved("nerfacto-embedding")[LOSS] == "none"
    for name, field in (("lidar", SOURCE), ("mono", SOURCE), ("gaussian", KERNEL)):
        assert {*differing(resolved("edge-paper"), resolved(f"edge-paper-{name}"))} == {field}, name
    assert differing(resolved("edge"), resolved("edge-sharp")).keys() == {SHARP}


@pytest.mark.parametrize("preset", ["lite", "full"])
def test_schedules_of_every_method_follow_the_steps_asked_for(preset):
    """By one rule: nothing but the number of steps is set, and lengths are shares of it."""
    assert len(METHODS) > 5
    shares = {f"pipeline.model.proposal_{name}" for name in ("warmup", "weights_anneal_max_num_iters")}
    for name in METHODS:
        whole, other = (resolved(name, preset, steps=steps) for steps in (None, 700))
        assert {*differing(whole, other)} == {"max_num_iterations"}
        groups = ("fields", "proposal_networks", "camera_opt")
        assert {other[f"optimizers.{group}.scheduler.max_steps"] for group in groups} == {None}
        assert all(0 < other[share] < 1 for share in shares)


@pytest.mark.parametrize("preset", ["lite", "full"])
def test_the_literal_method_is_the_registered_one_in_another_size(preset):
    ours, literal = resolved("edge", preset), resolved("edge-paper", preset)
    paper = flattened(make_specifications(read_method_file())[REGISTERED["paper"]].config)
    changed = differing(ours, literal)
    assert {PRIOR + "sigma_mode", PRIOR + "align", LAMBDA} <= set(changed)
    assert set(changed) <= {*literal_form()}
    for name in changed:
        assert literal[name] == paper[name], name


def test_the_paper_has_the_size_of_full_and_its_edge_is_the_literal_method():
    presets = read_method_file()["presets"]
    assert {**presets["paper"], **presets["full"]} == presets["paper"]
    assert not [name for name in literal_form() if not name.startswith(("pipeline.model.", "pipeline.datamanager."))]
    literal, ours = resolved("edge-paper", "full"), resolved("edge", "paper")
    assert set(differing(literal, ours)) <= {"method_name"}
    assert set(default_methods("lite")) - set(default_methods("paper")) == {"edge-paper"}


def test_only_seed_scene_and_folder_are_a_runs_own():
    one, two = (
        resolved("edge", folder=Path(f"/o/{scene}/edge_seed-{seed}"), scene=f"/s/{scene}", seed=seed)
        for seed, scene in enumerate("ab")
    )
    assert set(differing(one, two)) == {*OF_A_RUN} - {*OF_A_MACHINE}
    # a configuration reads the same in every process
    words = described(configuration(RunSpecification("/s/a", "", "lite", "edge", 0, 9))[0])
    assert words["pipeline.datamanager.collate_fn"] == "nerfstudio_collate"
    assert not [name for name, word in words.items() if " at 0x" in word]


def test_lambda_and_sigma_go_where_each_method_has_them():
    rival = resolved("ds-nerf", weight=0.07, sigma_m=0.2)
    assert (rival[LAMBDA], rival[SIGMA_FIELDS["ds-nerf"]]) == (0.07, 0.2)
    assert set(differing(rival, resolved("ds-nerf"))) == {LAMBDA, SIGMA_FIELDS["ds-nerf"]}
    ours = resolved("edge", weight=0.07, sigma_m=0.2)
    assert (ours[PRIOR + "sigma_mode"], ours[PRIOR + "sigma_constant_m"]) == ("constant", 0.2)
    own = resolved("edge", weight=0.07, sigma_m="own")
    assert set(differing(own, resolved("edge"))) == {LAMBDA}

    def setting(method, **changes):
        run = RunSpecification("/s/a", "", "lite", method, 0, 9, **changes)
        return setting_of(configuration(run)[0], method)

    assert setting("ds-nerf", weight=0.07, sigma_m=0.2) == (0.07, 0.2)
    assert setting("edge", weight=0.07, sigma_m=0.2) == (0.07, 0.2)
    assert setting("edge", weight=0.07, sigma_m="own") == (0.07, "calibrated")
    assert setting("nerfacto") == (None, None)


def test_departures_from_the_papers_protocol(tmp_path):
    names = [f"{index:03d}.png" for index in range(188)]
    meta = {
        "frames": [{"file_path": name, "frame": index} for index, name in enumerate(names)],
        "train_filenames": names[:150],
        "test_filenames": names[150:],
        "source": {"kind": "kitti360", "sweeps": 0, "deskew": False, "occlusion": False, "find_ego": False},
    }
    assert departures(meta) == []
    meta["source"] |= {"sweeps": 3, "deskew": True, "find_ego": True}
    meta["train_filenames"] = names[:70]
    found = " ".join(departures(meta))
    for part in ("70 training frames, not 150", "35% held out", "7 sweeps", "de-skewed", "vehicle itself"):
        assert part in found
