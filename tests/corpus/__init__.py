"""Thousands of bad and odd inputs for every command, and what must not come of them.

    python -m lab corpus             # a seeded sample
    python -m lab corpus --whole     # all

Each theme is a module with one function ``cases``; a ``Case`` is files, a command line, and what
the command may make. ``judge`` says what is wrong with how it ended.
"""
