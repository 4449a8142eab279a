"""Real training of the analytic line on any devices and hosts, which compiles in seconds.

As a script: ``python -m tests.line_run DELAY_S [name=value ...]``; each iteration takes at least that long.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rcg_jax.config import compose as cli
from rcg_jax.config.settings import Config
from rcg_jax.evaluate.success import make_evaluate
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.rollout import Sampler, begin, rollout
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.runs.program import Program
from rcg_jax.sharding.devices import choose, each_its_own, provide
from rcg_jax.sharding.hosts import number_of_processes
from rcg_jax.train_step import init_train_state, make_train_step
from rcg_jax.types import PhysicsState, StartSet
from tests.analytic import Line

#: 18 walks and 40 environments: four devices divide only the latter. The damping keeps conjugate gradients well
#: conditioned, so that runs which differ by rounding stay close.
SETTINGS = (
    "curriculum.num_new=20",
    "curriculum.num_old=12",
    "curriculum.num_candidates=180",
    "curriculum.brownian_horizon=10",
    "curriculum.brownian_horizon_max=40",
    "curriculum.replay_capacity=100",
    "rollout.num_envs=40",
    "rollout.batch_size=1000",
    "trpo.iterations=2",
    "trpo.cg_damping=0.02",
    "trpo.fisher_fraction=0.2",
    "policy.hidden=[16]",
    "policy.learn_std=true",
    "policy.action_repeat=1",
    "baseline.hidden=[16]",
    "baseline.minibatch_size=100",
    "eval_every=2",
    "checkpoint_every=1",
    "evaluation.episodes=10",
    "evaluation.final_episodes=10",
)


class SpreadLine(Line):
    """Stepped as physics is: by each device for its own environments."""

    def step(self, state: PhysicsState, action: Array) -> PhysicsState:
        return each_its_own(super().step)(state, action)


def line_config(*overrides: str) -> Config:
    return cli.compose_config([*SETTINGS, *overrides])


def load_line(config: Config, delay: float = 0.0) -> Program:
    provide(config.devices, number_of_processes(config.hosts))
    enable_compilation_cache()
    task = SpreadLine(horizon=40)
    devices = choose(config.devices, config.num_seeds)
    config = with_sizes(config, task.horizon, devices.share)
    devices.check_envs(config.rollout.num_envs)

    class Slow:
        """A compiled program that takes its time."""

        def __init__(self, jitted: Any) -> None:
            self.jitted = jitted

        def lower(self, *args: Any) -> Any:
            lowered = self.jitted.lower(*args)

            class Lowered:
                out_info = lowered.out_info

                def compile(self) -> Any:
                    compiled = lowered.compile()
                    return lambda *args: (time.sleep(delay), compiled(*args))[1]

            return Lowered()

    policy = make_policy(config, task.action_dim, config.policy.action_repeat)

    def evaluation(episodes: int) -> Any:
        evaluate = make_evaluate(policy, task, episodes)
        return lambda state, key: evaluate(state.agent.actor, key)

    compiled = partial(devices.jit, partial(jit, fusion_emitters=True))
    return Program(
        config=config,
        init=lambda seed: init_train_state(config, task, seed),
        step=make_train_step(config, task),
        starts=lambda state: (state.starts, state.labels),
        make_evaluate=evaluation,
        starts_sha256="ab" * 32,
        export=lambda folder, config, state, evaluation: (folder / "policy.npz").write_bytes(b"") and None,
        pictures=lambda folder: None,
        report=lambda folder: (),
        jit=lambda fun, **kwargs: Slow(compiled(fun, **kwargs)),
        device="CPU",
        devices=devices,
    )


def first_iteration(devices: str, seeds: int, *overrides: str) -> Any:
    """(state, metrics) after the first iteration on so many devices."""
    config = line_config("trpo.iterations=1", "rollout.batch_size=2000", *overrides)
    config = dataclasses.replace(config, num_seeds=seeds)
    task, layout = SpreadLine(horizon=40), choose(devices, seeds)
    states = [init_train_state(config, task, seed) for seed in range(seeds)]
    state = layout.placed(jax.tree.map(lambda *x: jnp.stack(x), *states) if seeds > 1 else states[0])
    step = make_train_step(config, task)
    compiled = layout.jit(partial(jit, fusion_emitters=True), layout.vmap(step) if seeds > 1 else step)
    state, metrics = compiled(state)
    return layout.local((state.replace(key=jax.random.key_data(state.key)), metrics))


def rollout_program(devices: str) -> str:
    """Text of the compiled program of one rollout, whose results stay where they were made."""
    task, layout = SpreadLine(horizon=40), choose(devices, 1)

    @layout.program
    def segment(key: Array, starts: StartSet) -> Any:
        begin_key, rollout_key = jax.random.split(key)
        env = begin(task, begin_key, starts, 40)
        sampler = Sampler(task, lambda obs, noise: noise)
        return rollout(sampler, rollout_key, env, starts, length=30, remaining=jnp.int32(90))

    return str(jax.jit(segment).lower(*layout.placed((jax.random.key(0), task.feasible_starts()))).compile().as_text())


if __name__ == "__main__":
    from rcg_jax import run
    from rcg_jax.runs import program

    pause = float(sys.argv[1])
    program.load_program = lambda config, **_: load_line(config, pause)
    sys.exit(run.main([*SETTINGS, *sys.argv[2:]]))
