#!/usr/bin/env bash
# onnxruntime 1.32.0 multiplies int8 matrices without AMX in a process that may use one CPU only: a
# quantised layer takes 2.5 times as long on that CPU as in a process with two, though the session
# has one thread either way. 1.31.1 takes the same time, and the values are the same. Seen on Linux
# with an Intel Xeon; it needs a processor with amx_int8 and two CPUs.
set -euo pipefail
grep -q amx_int8 /proc/cpuinfo && [ "$(nproc)" -gt 1 ] || { echo "no amx_int8, or one CPU"; exit 2; }
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cat > "$scratch/finding.py" << 'PYTHON'
import os, subprocess, sys, time
import numpy as np, onnx, onnxruntime as ort
from onnx import TensorProto as kinds, helper, numpy_helper

def model(inner, columns):
    rng = np.random.default_rng(0)
    constants = {"one": np.float32(1), "none": np.uint8(0),
                 "w": rng.integers(-64, 65, (inner, columns), dtype=np.int8),
                 "s": np.full(columns, 1e-3, "f4"), "no_w": np.zeros(columns, np.int8),
                 "b": np.zeros(columns, np.int32), "no_b": np.zeros(columns, np.int32)}
    node, value = helper.make_node, helper.make_tensor_value_info
    nodes = [node("DequantizeLinear", ["x", "one", "none"], ["xf"]),
             node("DequantizeLinear", ["w", "s", "no_w"], ["wf"], axis=1),
             node("DequantizeLinear", ["b", "s", "no_b"], ["bf"], axis=0),
             node("Gemm", ["xf", "wf", "bf"], ["y"]), node("QuantizeLinear", ["y", "one", "none"], ["q"])]
    given, made = (value(n, kinds.UINT8, ["n", k]) for n, k in (("x", inner), ("q", columns)))
    weights = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "graph", [given], [made], weights)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9)
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()

def microseconds():
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(model(2592, 96), options, providers=["CPUExecutionProvider"])
    values = np.random.default_rng(1).integers(0, 256, (256, 2592), dtype=np.uint8)
    best = np.inf
    for _ in range(300):
        begun = time.process_time()
        result = session.run(None, {"x": values})[0]
        best = min(best, time.process_time() - begun)
    return f"{1e6 * best} {int(result.astype(np.int64).sum())}"

if len(sys.argv) > 1:  # before any thread starts, as a container or a scheduler does it
    print(microseconds())
    sys.exit()
both = sorted(os.sched_getaffinity(0))[:2]
seen = []
for cpus in (both, both[:1]):
    os.sched_setaffinity(0, cpus)
    words = subprocess.check_output([sys.executable, __file__, "measure"], text=True).split()
    seen.append((float(words[0]), words[1]))
(two, sum_two), (one, sum_one) = seen
print(f"onnxruntime {ort.__version__}: {two:.0f} us with two CPUs allowed, {one:.0f} us with one")
assert sum_two == sum_one
slower = ort.__version__ == "1.32.0"
assert (one > 1.6 * two) == slower
PYTHON
for version in 1.31.1 1.32.0; do
    python3 -m venv "$scratch/$version"
    "$scratch/$version/bin/pip" install --quiet "onnxruntime==$version" onnx==1.19.1
    "$scratch/$version/bin/python" "$scratch/finding.py"
done
