"""Steps that are recorded on a GPU, and called on a CPU."""

from __future__ import annotations

import torch

from vsfsim.vsf.graphed_step import GraphedLoop, GraphedStep


def test_a_step_reads_what_was_refilled(device):
    given = torch.zeros(3, device=device)
    step = GraphedStep(lambda: given * 2.0, device=device)
    for k in range(6):
        given.fill_(float(k))
        assert step().tolist() == [2.0 * k] * 3


def test_a_loop_turns_as_often_as_its_own_numbers_say(device):
    given, made = torch.zeros((), device=device), {}

    def begin() -> torch.Tensor:
        made["left"], made["turns"] = given.clone(), torch.zeros((), device=device)
        made["goes_on"] = made["left"] > 0.0
        return made["goes_on"]

    def turn() -> None:
        made["left"].sub_(1.0)
        made["turns"].add_(1.0)
        made["goes_on"].copy_(made["left"] > 0.0)

    def end() -> torch.Tensor:
        return torch.stack([made["left"], made["turns"]])

    loop = GraphedLoop(begin, turn, end, most=5, device=device)
    for asked in (3, 0, 2, 1, 4, 0, 7, 5, 2):
        given.fill_(float(asked))
        assert loop().tolist() == [asked - min(asked, 5), min(asked, 5)]
