"""The errors of exported networks on held-out windows."""

import numpy as np
import pytest

from export.dataset import fill_shard, write_shard
from export.held_out import format_row, measure_files
from export.tests.small_net import small_net
from export.to_onnx import make_card, write_model
from export.train import HELD_OUT, Errors, Store, measure
from super_sdf.errors import ModelError
from super_sdf.network.network import shipped_models


def test_a_row_has_errors_in_voxels_and_dormant_units_in_percent():
    row = format_row("base.onnx", Errors(0.0139412, 0.018441, 0.03981), 0.0005)
    assert row == "| base.onnx | 0.01394 | 0.01844 | 0.0398 | 0.05 % |"


def test_a_file_has_the_errors_that_its_network_has_in_training(tmp_path):
    for number in range(HELD_OUT + 1):
        samples = fill_shard(np.random.default_rng(number), [], 1.0, thin=0.0, count=1)
        write_shard(tmp_path / f"shard-0-{number:04d}.npz", samples)
    net, path = small_net(), tmp_path / "small.onnx"
    write_model(net, path, make_card(net, "small", "nothing", "none"))
    errors = measure(net, Store(tmp_path, HELD_OUT).held_out)
    (row,) = measure_files([path], tmp_path)
    assert row.startswith(format_row(path.name, errors, 0).rsplit(" | ", 1)[0])


def test_an_int8_network_is_refused(tmp_path):
    path = shipped_models()["base"].with_name("base-int8.onnx")
    for number in range(HELD_OUT + 1):
        (tmp_path / f"shard-{number}.npz").touch()
    with pytest.raises(ModelError, match="is an int8 network: give the float32 network it was"):
        next(measure_files([path], tmp_path))
