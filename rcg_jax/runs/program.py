"""What the outer loop runs: the pure functions of one configuration, behind one small object."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache.compilation_cache import reset_cache

from rcg_jax.config.settings import Config
from rcg_jax.evaluate.success import make_evaluate
from rcg_jax.physics.jit import enable_compilation_cache, jit
from rcg_jax.policies.policy_file import save_policy
from rcg_jax.rl.agent import make_policy
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.runs.engine import choose_engine
from rcg_jax.runs.policy import FILE, make_card
from rcg_jax.runs.recorder import Evaluation
from rcg_jax.sharding.devices import Devices, choose, provide, start_on_half_the_cores
from rcg_jax.sharding.hosts import number_of_processes
from rcg_jax.tasks import make_task
from rcg_jax.tasks.check import check_task
from rcg_jax.tasks.randomize import randomized
from rcg_jax.train_step import init_train_state, make_train_step
from rcg_jax.types import StartLabels, StartSet

#: What to say of other engines than native on a CPU.
_SLOW = {
    "mjx": "on a CPU, engine=native is nearly twice as fast as engine=mjx on one of its devices; devices=all is the "
    "other way",
    "warp": "on a CPU, engine=native is more than 20 times as fast as engine=warp",
}


@dataclass(frozen=True)
class Program:
    """A training program; all functions are pure and not compiled.

    Attributes:
        config: the settings, resolved.
        init: seed, an integer that may be traced -> train state. The state has ``iteration``.
        step: state -> (state, metrics); metrics are a pytree of scalars.
        starts: state -> (StartSet, StartLabels) of its last iteration.
        make_evaluate: episodes -> (state, key) -> :class:`rcg_jax.evaluate.success.EvalResult`.
        starts_sha256: hash of the set of starts that evaluation draws from.
        export: (seed's folder, its settings, its train state, its final evaluation): writes its policy as a file.
        pictures: draws what a seed's folder holds into it.
        report: writes report.html about a seed's folder into it; returns what it had to leave out, each in one line.
        jit: compiles, with ``donate_argnums`` as ``jax.jit``.
        device: where it runs, in words.
        advice: one line that the user should know about this choice, or empty.
        devices: what states have to be placed on, and how seeds are spread over it.
    """

    config: Config
    init: Callable[[Any], Any]
    step: Callable[[Any], tuple[Any, Any]]
    starts: Callable[[Any], tuple[StartSet, StartLabels]]
    make_evaluate: Callable[[int], Callable[[Any, Any], Any]]
    starts_sha256: str
    export: Callable[[Path, Config, Any, Evaluation], None]
    pictures: Callable[[Path], None]
    report: Callable[[Path], Sequence[str]]
    jit: Callable[..., Any]
    device: str
    advice: str = ""
    devices: Devices = Devices()


def prepare(config: Config) -> None:
    """Sets JAX up for a run; to be called before anything is computed, in the file of an own class, too.

    Has no effect where this process already uses a device.
    """
    jax.config.update("jax_enable_x64", False)  # all of this package computes in float32
    if config.engine == "native":
        jax.config.update("jax_platforms", "cpu")  # it computes on the host
        if config.num_seeds == 1:  # several have enough to do for all cores
            start_on_half_the_cores()
    provide(config.devices, number_of_processes(config.hosts))


@contextmanager
def jax_settings_kept() -> Iterator[None]:
    """Context after which JAX's settings are what they were, for programs that train in their own process."""
    cache = "jax_compilation_cache_dir"
    names = ("jax_platforms", "jax_enable_x64", cache, "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    try:
        yield
    finally:
        if getattr(jax.config, cache) != before[cache]:
            reset_cache()  # JAX opens the folder once and keeps it
        for name, value in before.items():
            jax.config.update(name, value)


def load_program(
    config: Config,
    *,
    pictures: Callable[[Path], None] = lambda folder: None,
    report: Callable[[Path], Sequence[str]] = lambda folder: (),
) -> Program:
    """Builds the task and the functions that ``config`` describes; by default a finished run is not drawn.

    Raises:
        ConfigError: settings that do not fit the task, a task that breaks the contract, or has no feasible starts.
        RuntimeError: the engine does not run on this device.
    """
    config, _ = choose_engine(config)
    prepare(config)
    enable_compilation_cache()
    task = make_task(config.task, engine=config.engine)
    check_task(task)
    training = randomized(task, config.randomize)
    devices = choose(config.devices, config.num_seeds)
    config = with_sizes(config, task.horizon, devices.share)
    devices.check_envs(config.rollout.num_envs)
    policy = make_policy(config, task.action_dim, config.policy.action_repeat)
    device = jax.local_devices()[0]
    is_cpu = device.platform == "cpu"
    slow = _SLOW.get(config.engine, "") if is_cpu and devices.number == 1 else ""

    def make_evaluate_state(episodes: int) -> Callable[[Any, Any], Any]:
        evaluate = make_evaluate(policy, task, episodes)
        return lambda state, key: evaluate(state.agent.actor, key)

    def export(folder: Path, own: Config, state: Any, evaluation: Evaluation) -> None:
        actor = state.agent.actor
        save_policy(folder / FILE, actor, make_card(own, task, actor, evaluation.iteration, evaluation))

    compile_one = partial(jit, fusion_emitters=task.engine.fusion_emitters, matmul_precision=config.matmul_precision)
    return Program(
        config=config,
        init=lambda seed: init_train_state(config, task, seed),
        step=make_train_step(config, training),
        starts=lambda state: (state.starts, state.labels),
        make_evaluate=make_evaluate_state,
        starts_sha256=task.starts_sha256(),
        export=export,
        pictures=pictures,
        report=report,
        jit=partial(devices.jit, compile_one),
        device=("" if devices.number == 1 else f"{devices.number} x ")
        + ("CPU" if is_cpu else f"{device.device_kind} ({device.platform})"),
        advice=". ".join(filter(None, (slow, getattr(task.engine, "differs", "")))),
        devices=devices,
    )
