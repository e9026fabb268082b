#!/usr/bin/env bash
# onnxruntime 1.21 to 1.30 refuse a valid quantised layer, if it stands in the body of a Scan and
# takes scale and zero point of its rounding from outside: they make two nodes of one name.
# 1.20 and 1.31 load it. Without the Relu all do, with the same values: rounding to 0..255 with
# zero point 0 rectifies, too.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cat > "$scratch/finding.py" << 'PYTHON'
import numpy as np, onnx, onnxruntime as ort
from onnx import TensorProto as kinds, helper, numpy_helper

def model(relu):
    constants = {"one": np.float32(1), "none": np.uint8(0),
                 "w": np.arange(-16, 16, dtype=np.int8).reshape(8, 4), "s": np.full(4, .01, "f4"),
                 "no_w": np.zeros(4, np.int8), "b": np.arange(4, dtype=np.int32),
                 "no_b": np.zeros(4, np.int32)}
    outer, *inner = [numpy_helper.from_array(a, n) for n, a in constants.items()]
    outside, inside = [outer, inner[0]], inner[1:]
    node, value = helper.make_node, helper.make_tensor_value_info
    nodes = [node("DequantizeLinear", ["x", "one", "none"], ["xf"], "x_of"),
             node("DequantizeLinear", ["w", "s", "no_w"], ["wf"], "w_of", axis=1),
             node("DequantizeLinear", ["b", "s", "no_b"], ["bf"], "b_of", axis=0),
             node("Gemm", ["xf", "wf", "bf"], ["y"], "product")]
    nodes += [node("Relu", ["y"], ["r"], "rectifier")] * relu
    nodes += [node("QuantizeLinear", ["r" if relu else "y", "one", "none"], ["q"], "rounding")]
    given, made = (value(n, kinds.UINT8, ["n", k]) for n, k in (("x", 8), ("q", 4)))
    body = helper.make_graph(nodes, "body", [given], [made], inside)
    loop = node("Scan", ["xs"], ["qs"], "loop", body=body, num_scan_inputs=1)
    whole = [value(n, kinds.UINT8, ["m", "n", k]) for n, k in (("xs", 8), ("qs", 4))]
    graph = helper.make_graph([loop], "graph", whole[:1], whole[1:], outside)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()

def run(relu):
    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(model(relu), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        return str(error).split("Error: ")[-1]
    inputs = np.random.default_rng(0).integers(0, 256, (2, 5, 8), dtype=np.uint8)
    return session.run(None, {"xs": inputs})[0]

minor = int(ort.__version__.split(".")[1])
with_relu, without = run(True), run(False)
refused = isinstance(with_relu, str)
print("onnxruntime", ort.__version__, "with Relu:", with_relu if refused else "loads", end="; ")
print("without:", without if isinstance(without, str) else "loads")
assert refused == (21 <= minor <= 30)
assert without.any() and (refused or (with_relu == without).all())
PYTHON
for version in 1.20.1 1.21.1 1.23.2 1.31.1; do
    python3 -m venv "$scratch/$version"
    "$scratch/$version/bin/pip" install --quiet "onnxruntime==$version" onnx==1.19.1
    "$scratch/$version/bin/python" "$scratch/finding.py"
done
