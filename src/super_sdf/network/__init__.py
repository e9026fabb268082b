"""The network: an ONNX file, its contract, and the device that it runs on."""
