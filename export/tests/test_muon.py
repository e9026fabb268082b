"""Matrices updated together go where those updated one by one go."""

import torch

from export.muon import StackedMuon, orthogonal

RATE = {"lr": 0.01, "weight_decay": 1e-3, "adjust_lr_fn": "match_rms_adamw"}
SHAPES = [(32, 12), (12, 32), (32, 12), (12, 12), (32, 12)]


def matrices():
    torch.manual_seed(0)
    return [torch.nn.Parameter(torch.randn(shape)) for shape in SHAPES]


def test_steps_are_those_of_torch():
    alone, together = matrices(), matrices()
    optimisers = torch.optim.Muon(alone, **RATE), StackedMuon(together, **RATE)
    for _ in range(4):
        for one, other in zip(alone, together):
            one.grad = torch.randn_like(one)
            other.grad = one.grad.clone()
        for optimiser in optimisers:
            optimiser.step()
    for start, one, other in zip(matrices(), alone, together):
        moved = (one - start).norm()
        assert (one - other).norm() < 0.05 * moved  # the iterations are in bfloat16


def test_a_run_of_torchs_muon_goes_on():
    one, other = matrices(), matrices()
    before, after = torch.optim.Muon(one, **RATE), StackedMuon(other, **RATE)
    for matrix in one:
        matrix.grad = torch.ones_like(matrix)
    before.step()
    after.load_state_dict(before.state_dict())
    for mine, theirs in zip(other, one):
        torch.testing.assert_close(after.state[mine], before.state[theirs])


def test_singular_values_become_equal():
    torch.manual_seed(1)
    for shape in [(3, 40, 16), (3, 16, 40)]:
        found = orthogonal(torch.randn(shape), (3.4445, -4.775, 2.0315), 5).float()
        values = torch.linalg.svdvals(found)
        assert values.min() > 0.6 and values.max() < 1.25
