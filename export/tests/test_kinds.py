"""Which kinds of shapes the error comes from."""

import numpy as np

from export.dataset import SIZES
from export.kinds import RANGES, draw_windows, drawn_from, format_table
from export.recipe import Errors
from export.shapes.solid import FAMILIES


def test_a_table_has_the_kind_with_the_largest_error_first():
    rows = {
        "ball": [Errors(0.1, 0.01, 0.001)] * 3,
        "gear": [Errors(0.1, near, 0.02) for near in (0.02, 0.03, 0.04)],
    }
    assert format_table(rows).splitlines() == [
        "| kind | 7 to 17 | 17 to 41 | 41 to 100 | part of all |",
        "| --- | ---: | ---: | ---: | ---: |",
        "| gear | 2.00, 2.0 | 3.00, 2.0 | 4.00, 2.0 | 75.0 % |",
        "| ball | 1.00, 0.1 | 1.00, 0.1 | 1.00, 0.1 | 25.0 % |",
    ]


def test_windows_of_a_kind_are_as_many_as_were_asked_of_the_sizes_of_training():
    assert (RANGES[0][0], RANGES[-1][-1]) == SIZES
    assert [low for low, _ in RANGES[1:]] == [high for _, high in RANGES[:-1]]
    windows = draw_windows(np.random.default_rng(1), drawn_from(FAMILIES["prism"]), (7, 17), 3)
    assert len(windows) == 3 and all(len(window.targets) for window in windows)
