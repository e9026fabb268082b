"""The errors of exported networks on held-out windows."""

import pytest

from export.dataset import write_shard
from export.held_out import row_of
from export.recipe import Errors, measure
from export.store import HELD_OUT, Store
from export.tests.small_net import small_net
from super_sdf.errors import ModelError
from super_sdf.network.network import shipped_models


def test_a_file_has_the_errors_that_its_network_has_in_training(tmp_path, small_file, samples):
    for number in range(HELD_OUT + 1):
        write_shard(tmp_path / f"shard-0-{number:04d}.npz", samples[number : number + 1])
    errors = measure(small_net(), Store(tmp_path).held_out)
    assert row_of(small_file, tmp_path).startswith(f"| small.onnx | {' | '.join(errors.cells())} |")
    assert Errors(0.0139412, 0.018441, 0.03981).cells() == ["0.01394", "0.01844", "0.0398"]
    with pytest.raises(ModelError, match="is an int8 network: give the float32 network it was"):
        row_of(shipped_models()["base-int8"], tmp_path)
