"""Pages for a browser: reports of conversions, and a viewer of meshes; needs the extra ``report``.

It may import ``pictures``, ``certificate``, ``evaluation``, ``simplification`` and what lies below.
"""
