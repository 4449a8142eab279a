"""Benchmarks, and the figures and tables of the paper: one short script each."""

import rcg_jax as rcg_jax  # before any script imports JAX: it decides how XLA logs
