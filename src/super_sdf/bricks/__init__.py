"""One huge grid on the workers of a cluster: bricks of planes, read and meshed where they are.

``stored`` reads planes from a store that all workers see, ``passes`` gives workers ranges of planes
and puts the results in order, ``meshing`` is their side, and ``engine`` is what ``convert`` uses.
"""
