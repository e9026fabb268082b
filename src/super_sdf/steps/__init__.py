"""The steps of the method, each from arrays to arrays.

They may import ``network`` and what lies below, but no files.
"""
