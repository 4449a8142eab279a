"""The curriculum as a plain object, for a trainer of one's own: Algorithm 1 without train_pol.

    curriculum = ReverseCurriculum("ring_peg", seed=0)
    while training:
        starts = curriculum.propose(64)                    # states to begin 64 episodes in
        successes = run_and_learn(starts.qpos, starts.qvel)
        curriculum.report(starts, successes)

NumPy in and out; inside are the same ``propose`` and ``update`` that the train step uses.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rcg_jax.config.compose import compose_config, given_names
from rcg_jax.config.settings import Config, ConfigError
from rcg_jax.io.manifest import brief
from rcg_jax.io.npz import load_npz
from rcg_jax.io.tables import write_atomically
from rcg_jax.methods.reverse import Reverse
from rcg_jax.physics.jit import jit
from rcg_jax.rl.sizes import with_sizes
from rcg_jax.sharding.devices import start_on_half_the_cores
from rcg_jax.tasks import Task, task_class
from rcg_jax.tasks.training import checked_task, resolve
from rcg_jax.types import StartLabels, StartSet, sample_rows


class Starts(NamedTuple):
    """States to begin episodes in.

    Attributes:
        qpos: (n, nq) positions.
        qvel: (n, nv) velocities; zero.
        row: (n,) which starts of rho_i they are.
        iteration: the curriculum iteration of that rho_i.
        act: (n, na) activations; None where the model has none.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    row: np.ndarray
    iteration: int
    act: np.ndarray | None = None


class ReverseCurriculum:
    """Reverse curriculum generation on a task, one iteration after another (Algorithm 1).

    An iteration has a set of starts rho_i: N_new found by SampleNearby and N_old of the replay. It ends when
    ``episodes`` of its episodes were reported; then the good starts become seeds and enter the replay, and new starts
    are found: spread over positions, and over V(s) where the trainer gives its value function.

    Attributes:
        task: task and physics of the walks.
        config: the settings; those of the curriculum count.
        iteration: iterations done.
        starts: rho_i, of constant capacity.
        episodes: how many episodes end an iteration.
        metrics: of the last iteration, by name: share_low, share_good, share_high, brownian_horizon, replay_size, ...
    """

    def __init__(
        self,
        task: str | Task,
        *,
        seed: int = 0,
        episodes: int | None = None,
        value: Callable[[np.ndarray], np.ndarray] | None = None,
        settings: Sequence[str] = (),
        engine: str = "native",
    ) -> None:
        """A curriculum that begins at the goal state.

        Args:
            task: as of ``task=`` on the command line, or a task that is built.
            seed: of everything random.
            episodes: how many end an iteration; by default four for each start.
            value: the trainer's V, of raw observations (n, obs_dim) whenever it is asked: (n,). With it a part of the
                new starts, ``curriculum.value_share``, is spread over V(s), as with our trainer.
            settings: as on the command line: ``["curriculum.num_new=100", "method=all_starts"]``.
            engine: physics, of a task given by name.

        Raises:
            ValueError: no such task, or ``episodes`` < 1.
            ConfigError: a setting that is unknown, not allowed or not of the curriculum; guidance by rho_0, or by V
                without ``value``.
        """
        if isinstance(settings, str):
            raise ConfigError(f"settings={settings!r}: must be a list of name=value words")
        if value is not None and not callable(value):
            raise ConfigError(f"value={value!r}: must be a function of observations")
        config, given = compose_config(settings), given_names(settings)
        for name in sorted(given):
            if not name.startswith("curriculum.") and name not in ("method", "preset"):
                raise ConfigError(f"{name}: must be a setting curriculum.*, method or preset")
        if engine == "native":
            start_on_half_the_cores()  # the others are MuJoCo's
        cls = type(task) if isinstance(task, Task) else task_class(task)
        config, _ = resolve(config, given, task=cls, groups=("curriculum",))
        if value is None and "curriculum.value_share" in given and config.curriculum.value_share:
            raise ConfigError("curriculum.value_share: needs value, the trainer's value function; must be 0")
        if value and (config.curriculum.selection != "spread" or not config.curriculum.value_share):
            raise ConfigError("value: needs curriculum.selection=spread and curriculum.value_share > 0")
        if "curriculum.rho_0_share" in given and config.curriculum.rho_0_share:
            raise ConfigError("curriculum.rho_0_share: needs the trainer's observations; must be 0")
        if config.method not in ("reverse", "all_starts"):
            raise ConfigError(f"method={config.method}: must be reverse or all_starts")
        share = config.curriculum.value_share if value else 0.0
        plain = dataclasses.replace(config.curriculum, value_share=share, rho_0_share=0.0)
        self.task = checked_task(task, engine)
        self.config: Config = with_sizes(dataclasses.replace(config, curriculum=plain), self.task.horizon)
        baseline = _from_outside(value) if value else None
        self._method = Reverse(self.task, self.config, all_starts=config.method == "all_starts", baseline=baseline)
        self._advance = jit(self._next, fusion_emitters=self.task.engine.fusion_emitters)
        self._rows = jax.jit(lambda key, starts: sample_rows(key, starts, starts.capacity))
        key, init_key = jax.random.split(jax.random.key(seed))
        self.iteration, self.metrics = 0, dict[str, float]()
        self._key, state = key, self._method.init(init_key)
        propose = jit(
            lambda key, state: self._method.propose(key, state, _OUTSIDE),
            fusion_emitters=self.task.engine.fusion_emitters,
        )
        self._state, self.starts = propose(self._split(), state)
        self._labels = _none(self.starts.capacity)
        self.episodes = 4 * self.starts.capacity if episodes is None else episodes
        if self.episodes < 1:
            raise ValueError(f"episodes={self.episodes}: must be at least 1")

    def _split(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key

    def _next(self, key: jax.Array, state: Any, starts: StartSet, labels: StartLabels) -> Any:
        update_key, propose_key = jax.random.split(key)
        state, metrics = self._method.update(update_key, state, starts, labels)
        return *self._method.propose(propose_key, state, _OUTSIDE), metrics

    def propose(self, n: int) -> Starts:
        """``n`` starts of rho_i, each as often as the others, up to one, in random order.

        Raises:
            ValueError: ``n`` < 1.
        """
        if n < 1:
            raise ValueError(f"n={n}: must be at least 1")
        capacity = self.starts.capacity
        rows = np.concatenate([np.asarray(self._rows(self._split(), self.starts)) for _ in range(-(-n // capacity))])[
            :n
        ]
        chosen = jax.tree.map(lambda x: np.asarray(x)[rows], self.starts)
        return Starts(chosen.qpos, chosen.qvel, rows, self.iteration, chosen.act)

    def report(self, starts: Starts, successes: np.ndarray, steps: np.ndarray | None = None) -> bool:
        """What became of one episode from each of ``starts``.

        Report whole batches. Were the episodes that end early reported as they come, quick successes would be counted
        more often than slow failures.

        Args:
            starts: as proposed; those of an earlier iteration count for nothing.
            successes: (n,) bool, whether the goal was reached in time.
            steps: (n,) physics steps to the goal, of the successes; without them mastered starts count as equally far.

        Returns:
            Whether an iteration ended with it, so that ``self.starts`` are new.

        Raises:
            ValueError: not one outcome, true or false, for each start; steps below 0; or starts that are none of these.
        """
        if not isinstance(starts, Starts):
            raise ValueError(f"starts: must be those that propose gave, not {type(starts).__name__}")
        successes = np.asarray(successes)
        if not np.isin(successes, (0, 1)).all():
            raise ValueError("successes: must be true or false, or 1 or 0")
        successes = successes.astype(bool)
        steps = np.zeros(len(successes), int) if steps is None else np.asarray(steps)
        if not (np.isfinite(steps) & (steps >= 0)).all():
            raise ValueError("steps: must be numbers >= 0")
        steps = steps.astype(int)
        for name, value in (("successes", successes), ("steps", steps)):
            if value.shape != starts.row.shape:
                raise ValueError(f"{name}: must have the shape {starts.row.shape} of the starts, not {value.shape}")
        if starts.iteration != self.iteration:
            return False
        if not ((starts.row >= 0) & (starts.row < self.starts.capacity)).all():
            raise ValueError(f"starts: rows must be 0 to {self.starts.capacity - 1}, as propose gave them")
        for total, value in zip(self._labels, (successes, np.ones_like(steps), np.where(successes, steps, 0))):
            np.add.at(total, starts.row, value)
        if self._labels[1].sum() < self.episodes:
            return False
        labels = StartLabels(*map(jnp.asarray, self._labels))
        self._state, self.starts, metrics = self._advance(self._split(), self._state, self.starts, labels)
        self.metrics = {field.name: float(getattr(metrics, field.name)) for field in dataclasses.fields(metrics)}
        self._labels, self.iteration = _none(self.starts.capacity), self.iteration + 1
        return True

    def save(self, path: str | Path) -> None:
        """Writes everything that is needed to go on, atomically, as one npz file.

        Raises:
            OSError: it could not be written; what was there before still is.
        """
        buffer = io.BytesIO()
        np.savez(buffer, **self._arrays())  # type: ignore[arg-type]
        write_atomically(Path(path), buffer.getvalue())

    def load(self, path: str | Path) -> None:
        """Goes on from what :meth:`save` wrote, of a curriculum with the same task, settings and use of ``value``.

        ``metrics`` are those of iterations since then.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is damaged, of another task, or of other settings.
        """
        mine = self._arrays()
        data = Path(path).read_bytes()
        try:
            arrays = load_npz(data, 2 * sum(value.nbytes for value in mine.values()))
        except Exception as error:  # what numpy and zipfile raise depends on which byte is wrong
            raise ValueError(f"{path}: is no file of a curriculum, or damaged ({brief(error)})") from None
        wanted = {name: (value.shape, value.dtype) for name, value in mine.items()}
        found = {name: (value.shape, value.dtype) for name, value in arrays.items()}
        if found != wanted or arrays["about"] != mine["about"]:
            raise ValueError(f"{path}: is of another task, or of other settings of the curriculum")
        self._key = jax.random.wrap_key_data(jnp.asarray(arrays["key"]))
        self.iteration = int(arrays["iteration"])
        self._labels = tuple(arrays[f"labels{i}"] for i in range(3))
        leaves, structure = jax.tree.flatten((self._state, self.starts))
        self._state, self.starts = jax.tree.unflatten(
            structure, [jnp.asarray(arrays[f"leaf{i}"]) for i in range(len(leaves))]
        )

    def _arrays(self) -> dict[str, np.ndarray]:
        leaves = {f"leaf{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves((self._state, self.starts)))}
        labels = {f"labels{i}": value for i, value in enumerate(self._labels)}
        key = np.asarray(jax.random.key_data(self._key))
        about = f"{self.task.name} {self.config.method} {self.episodes} {self.config.curriculum}"
        digest = np.frombuffer(hashlib.sha256(about.encode()).digest()[:8], np.int64)[0]
        return {**leaves, **labels, "key": key, "iteration": np.asarray(self.iteration), "about": np.asarray(digest)}


#: What the method asks of an agent, where that is somewhere else: observations stay raw, V has no parameters.
_OUTSIDE: Any = SimpleNamespace(norm=lambda obs: obs, baseline=None)


def _from_outside(value: Callable[[np.ndarray], np.ndarray]) -> Callable[[Any, jax.Array], jax.Array]:
    """A trainer's V as the method calls its own."""

    def host(obs: jax.Array) -> np.ndarray:
        values = np.asarray(value(np.asarray(obs)), np.float32)
        if values.shape == (len(obs), 1):
            values = values[:, 0]
        if values.shape != (len(obs),):
            raise ValueError(f"value: must return ({len(obs)},) values for as many observations, not {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError("value: returned NaN or infinite values")
        return values

    return lambda _, obs: jax.pure_callback(host, jax.ShapeDtypeStruct(obs.shape[:1], jnp.float32), obs)


def _none(capacity: int) -> tuple[np.ndarray, ...]:
    """Successes, episodes, and steps to the goal of no episode."""
    return tuple(np.zeros(capacity, np.int32) for _ in range(3))
