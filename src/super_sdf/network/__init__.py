"""The network: an ONNX file, its contract, and the device that it runs on.

It may import ``files`` and the rooms below it.
"""
