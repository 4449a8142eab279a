"""One web page about a run, or about several to compare: ``python -m rcg_jax.report run=DIR [run=DIR ...]``.

The page is a single file that needs no network: settings, learning curves, how the starts grew, final success, videos.
It draws with Chart.js (``assets/``, MIT licence).
"""
