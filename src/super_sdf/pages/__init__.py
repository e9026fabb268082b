"""Pages for a browser: reports of conversions, and a viewer of meshes; needs the extra ``report``.

It may import ``certificate``, ``simplification`` and what lies below.
"""
