"""Benchmarks, and the figures and tables of the paper: one short script each."""
