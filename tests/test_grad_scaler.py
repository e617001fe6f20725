"""The scale of mixed precision, looked at now and then; on tensors of the CPU, which it takes for a GPU's."""

from __future__ import annotations

import pytest
import torch

from edge_depth_nerf.plugin.grad_scaler import STEPS_PER_LOOK, PatientGradScaler


@pytest.fixture
def scaler(monkeypatch) -> PatientGradScaler:
    monkeypatch.setattr("torch.cuda.amp.common.amp_definitely_not_available", lambda: False)
    return PatientGradScaler(enabled=True)


def step(scaler: PatientGradScaler, weight: torch.nn.Parameter, gradient: float) -> None:
    optimiser = torch.optim.SGD([weight], lr=1.0)
    optimiser.zero_grad()
    scaler.scale((weight * gradient).sum()).backward()
    scaler.step(optimiser)
    scaler.update()


def test_a_skipped_step_is_seen_at_the_next_look_alone(scaler):
    weight = torch.nn.Parameter(torch.zeros(1))
    scales = []
    for number in range(2 * STEPS_PER_LOOK):
        before = scaler.get_scale()
        step(scaler, weight, float("inf") if number == 3 else 1.0)
        scales.append((before, scaler.get_scale()))
    assert float(weight.detach()) == -(2 * STEPS_PER_LOOK - 1)  # the step was skipped at once
    fallen = [number for number, (before, after) in enumerate(scales) if before > after]
    assert fallen == [STEPS_PER_LOOK - 1]
    assert scales[0][0] == 2.0**16 and scales[-1][1] == 2.0**15


def test_while_gradients_add_up_the_scale_stays(scaler):
    """--gradient-accumulation-steps: in most steps no optimiser steps, but nerfstudio updates the scale."""
    weight = torch.nn.Parameter(torch.zeros(1))
    for _ in range(3):
        scaler.scale((weight * 2.0).sum()).backward()
        scaler.update()
    assert scaler.get_scale() == 2.0**16 and scaler._updates == 0
    step(scaler, weight, 1.0)
    assert scaler._updates == 1


def test_a_checkpoint_keeps_the_scale_of_its_moment(scaler, monkeypatch):
    weight = torch.nn.Parameter(torch.zeros(1))
    step(scaler, weight, float("inf"))
    assert scaler.get_scale() == 2.0**16
    state = scaler.state_dict()
    assert state["scale"] == 2.0**15
    other = PatientGradScaler(enabled=True)
    other.load_state_dict(state)
    assert other.get_scale() == 2.0**15
    step(other, weight, 1.0)
    assert other.state_dict()["scale"] == 2.0**15 and other.state_dict()["_growth_tracker"] == 1
