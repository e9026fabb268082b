"""The measuring stick: grids from meshes, quality against truth and peers, tables, pictures.

It needs the extra ``eval`` (libigl, SciPy, scikit-image, matplotlib), pictures of meshes the extra
``view`` (PyVista); the runtime imports nothing from here.

    solid -> sampling -> cases -> methods, peers -> measuring -> store, runner -> tables, plots
    -> report
"""
