"""The options that upsample and batch share."""

from pathlib import Path

import numpy as np
import pytest
from conftest import ball

from super_sdf.network.network import shipped_models


@pytest.mark.parametrize("quality", ["base", "best"])
@pytest.mark.parametrize("words", ["upsample in.npy out.ply", "batch in.npy --out meshes"])
def test_a_model_and_a_quality_are_not_given_at_once(
    tmp_path, monkeypatch, command, quality, words
):
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", ball().values)
    model = str(shipped_models()["fast"])
    message = f"Error: --model {model} replaces --quality {quality}: give only one of them\n"
    refused = command(*words.split(), "--model", model, "--quality", quality)
    assert refused == (2, "", message)
    assert [path.name for path in Path().iterdir()] == ["in.npy"]
    assert command(*words.split(), "--model", model)[0] == 0
