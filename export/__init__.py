"""From meshes to a shipped network: shapes, sampling, data, training, ONNX export."""
