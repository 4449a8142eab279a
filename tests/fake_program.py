"""A training program without physics, for tests of the outer loop.

As a script: ``python -m tests.fake_program RUN_DIR ITERATIONS DELAY_S [name=value ...]``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rcg_jax.config import compose as cli
from rcg_jax.config.settings import Config
from rcg_jax.rl.episodes import Episodes
from rcg_jax.runs.program import Program
from rcg_jax.types import StartLabels, StartSet


@struct.dataclass
class FakeState:
    key: Array
    iteration: Array
    x: Array
    empty: Array


@struct.dataclass
class FakeStarts:
    share_good: Array


@struct.dataclass
class FakeMetrics:
    iteration: Array
    env_steps: Array
    success: Array
    start_distance: Array
    starts: FakeStarts


@struct.dataclass
class FakeResult:
    successes_stochastic: Array
    successes_mean: Array
    episodes: Array
    start: Array
    stochastic: Episodes
    mean: Episodes


def init(seed: int) -> FakeState:
    # The weak type of 0.5 * ... must not survive into the compiled program.
    return FakeState(jax.random.key(seed), jnp.int32(0), jnp.full((8, 4), 0.5), jnp.zeros((0, 3)))


def step(state: FakeState) -> tuple[FakeState, FakeMetrics]:
    key, noise = jax.random.split(state.key)
    x = jnp.sin(state.x * 3.0 + jax.random.normal(noise, state.x.shape))
    after = FakeState(key, state.iteration + 1, x, state.empty)
    mean = jnp.mean(x)
    return after, FakeMetrics(after.iteration, jnp.int32(1000), mean, mean * 2, FakeStarts(mean * mean))


def starts(state: FakeState) -> tuple[StartSet, StartLabels]:
    valid = state.x[..., 0] > -0.5
    labels = StartLabels(successes=valid * 2, episodes=valid * 3, steps=valid * 4)
    return StartSet(qpos=state.x, qvel=state.x, valid=valid), labels


def make_evaluate(episodes: int) -> Callable[[FakeState, Array], FakeResult]:
    def evaluate(state: FakeState, key: Array) -> FakeResult:
        drawn = jax.random.uniform(key, (episodes,)) < jnp.abs(jnp.mean(state.x))
        one = Episodes(success=drawn, length=jnp.arange(episodes), bad=~drawn)
        return FakeResult(
            jnp.sum(drawn), jnp.sum(drawn) // 2, jnp.int32(episodes), jnp.arange(episodes), stochastic=one, mean=one
        )

    evaluate.__name__ = f"evaluate_{episodes}"
    return evaluate


_COMPILED: dict[str, Any] = {}


@dataclass(frozen=True)
class SlowJit:
    """``jax.jit`` whose compiled programs take at least ``delay`` seconds, and are compiled once per process."""

    delay: float
    fun: Callable[..., Any] | None = None

    def __call__(self, fun: Callable[..., Any], **kwargs: Any) -> SlowJit:
        return SlowJit(self.delay, fun)

    def lower(self, *args: Any) -> SlowCompiled:
        return SlowCompiled(self, args)


@dataclass(frozen=True)
class SlowCompiled:
    jitted: SlowJit
    args: Any

    @property
    def out_info(self) -> Any:
        assert self.jitted.fun is not None
        return jax.eval_shape(self.jitted.fun, *self.args)

    def compile(self) -> Callable[..., Any]:
        fun, delay = self.jitted.fun, self.jitted.delay
        assert fun is not None
        key = fun.__name__ + str(jax.eval_shape(lambda args: args, self.args))
        if key not in _COMPILED:
            _COMPILED[key] = jax.jit(fun).lower(*self.args).compile()

        def call(*args: Any) -> Any:
            time.sleep(delay)
            return _COMPILED[key](*args)

        return call


def write_report(folder: Path) -> list[str]:
    (folder / "report.html").write_bytes(b"")
    return ["no videos: nothing to see"]


def load_fake(config: Config, delay: float = 0.0) -> Program:
    return Program(
        config=config,
        init=init,
        step=step,
        starts=starts,
        make_evaluate=make_evaluate,
        starts_sha256="ab" * 32,
        export=lambda folder, config, state, evaluation: (folder / "policy.npz").write_bytes(b"") and None,
        pictures=lambda folder: (folder / "picture.png").write_bytes(b"") and None,
        report=write_report,
        jit=SlowJit(delay),
        device="CPU",
    )


def fake_config(run_dir: Path, *overrides: str) -> Config:
    small = [
        "engine=mjx",
        "evaluation.episodes=10",
        "evaluation.final_episodes=20",
        "eval_every=3",
        "checkpoint_every=2",
    ]
    return cli.compose_config([f"run_dir='{run_dir}'", *small, *overrides])


if __name__ == "__main__":
    from rcg_jax.runs import train as loop
    from rcg_jax.runs.interrupt import Interrupted
    from rcg_jax.runs.progress import Reporter

    config = fake_config(Path(sys.argv[1]), f"iterations={sys.argv[2]}", *sys.argv[4:])
    pause = float(sys.argv[3])
    try:
        loop.run(config, report=Reporter(), command="again", load=lambda config: load_fake(config, pause))
    except Interrupted as stop:
        sys.exit(stop.exit_code)
    except loop.RunError as failure:
        print(f"error: {failure}", file=sys.stderr)
        sys.exit(1)
