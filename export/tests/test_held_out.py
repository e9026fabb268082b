"""The errors of exported networks on held-out windows."""

from export.held_out import format_row
from export.train import Errors


def test_a_row_has_errors_in_voxels_and_dormant_units_in_percent():
    row = format_row("base.onnx", Errors(0.0139412, 0.018441, 0.03981), 0.0005)
    assert row == "| base.onnx | 0.01394 | 0.01844 | 0.0398 | 0.05 % |"
