"""From meshes to a shipped network: sampling, data, training, ONNX export. Never imported by super_sdf."""
