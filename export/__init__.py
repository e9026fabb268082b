"""From meshes to a shipped network: shapes, sampling, training data, training, ONNX export."""
