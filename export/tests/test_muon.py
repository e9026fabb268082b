"""Matrices updated together go where those updated one by one go."""

import torch

from export.muon import StackedMuon

RATE = {"lr": 0.01, "weight_decay": 1e-3, "adjust_lr_fn": "match_rms_adamw"}
SHAPES = [(32, 12), (12, 32), (32, 12), (12, 12), (32, 12)]


def matrices():
    torch.manual_seed(0)
    return [torch.nn.Parameter(torch.randn(shape)) for shape in SHAPES]


def test_steps_are_those_of_torch_whose_runs_go_on():
    alone, together = matrices(), matrices()
    one, other = torch.optim.Muon(alone, **RATE), StackedMuon(together, **RATE)
    for _ in range(4):
        for mine, theirs in zip(together, alone):
            theirs.grad = torch.randn_like(theirs)
            mine.grad = theirs.grad.clone()
        one.step()
        other.step()
    for start, mine, theirs in zip(matrices(), together, alone):
        assert (mine - theirs).norm() < 0.05 * (theirs - start).norm()  # it works in bfloat16
    other.load_state_dict(one.state_dict())
    for mine, theirs in zip(together, alone):
        torch.testing.assert_close(other.state[mine], one.state[theirs])
