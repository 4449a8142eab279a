"""Fixtures shared by all tests: tasks that are built, and programs that are compiled, once per session."""

from __future__ import annotations

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # the native engine, and comparisons to the last bit, need a CPU

import pytest

from rcg_jax.physics.jit import enable_compilation_cache
from rcg_jax.tasks import Task, make_task


@pytest.fixture(scope="session", autouse=True)
def compilation_cache() -> None:
    """Repeated test runs load their compiled programs from disk."""
    enable_compilation_cache()


@pytest.fixture(scope="session")
def ring_peg_native() -> Task:
    return make_task("ring_peg", "native")


@pytest.fixture(scope="session")
def ring_peg_mjx() -> Task:
    return make_task("ring_peg", "mjx")


@pytest.fixture(scope="session")
def ring_peg_warp() -> Task:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    return make_task("ring_peg", "warp")
