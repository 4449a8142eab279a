"""The parts of a run: resume, compile, iterate, evaluate, save. All side effects of training are here."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from rcg_jax.config.settings import Config
from rcg_jax.runs import checkpoint
from rcg_jax.runs.finish import write_products, write_report
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.interrupt import Interrupted, Interrupts
from rcg_jax.runs.memory import shortage
from rcg_jax.runs.program import Program
from rcg_jax.runs.progress import Progress, Reporter
from rcg_jax.runs.recorder import WALL_CLOCK, Evaluation, Recorder, has_evaluation
from rcg_jax.runs.seeds import evaluation_key, metric_rows, outcome_rows, stack, strong, unstack
from rcg_jax.runs.start_record import start_row
from rcg_jax.sharding.hosts import Hosts


class RunError(RuntimeError):
    """A run cannot start or go on; the message is one line."""


class Loop:
    """One run of S seeds in one program."""

    def __init__(
        self,
        config: Config,
        program: Program,
        *,
        folders: list[RunFolder],
        report: Reporter,
        interrupts: Interrupts,
        hosts: Hosts,
    ) -> None:
        """Args: config, and everything that it implies; ``folders`` are open in the first process."""
        self.config, self.program, self.folders = config, program, folders
        self.report, self.interrupts, self.hosts = report, interrupts, hosts
        self.seeds = [folder.config.seed for folder in folders]
        self.recorders: list[Recorder] = []
        self.done = 0
        self.saved = 0
        self.evaluated: tuple[int, float] | None = None
        self._told_nonfinite = False
        self._evaluate: dict[int, Callable[..., Any]] = {}

    def _vmap(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        return fun if len(self.seeds) == 1 else self.program.devices.vmap(fun)

    def _compute(self, fun: Callable[[], Any], *, finish: bool = False, tick: Callable[[], None] | None = None) -> Any:
        # No process leaves a computation that the others are in.
        return self.interrupts.call(
            lambda: jax.block_until_ready(fun()),
            finish=finish or self.hosts.number > 1,
            tick=self.report.tick if tick is None else tick,
        )

    def told(self, value: Any) -> Any:
        """The first process's ``value``, in all of them."""
        return self._compute(lambda: self.hosts.told(value))

    def start(self) -> Any:
        """The state to continue from: the newest intact checkpoint, or a new one.

        Raises:
            CheckpointError: there are checkpoints, but none is intact.
        """
        state = self._restore() if self.hosts.is_first else None
        self.done = self.saved = int(self.told(np.int32(self.done)))
        if state is None:
            # Compiled as a whole: one by one, its many small operations take longer.
            init = jax.jit(self.program.init)
            state = self._compute(lambda: strong(stack([init(seed) for seed in self.seeds])))
        return self.program.devices.placed(self.told(state))

    def _restore(self) -> Any | None:
        """The newest intact checkpoint; None where there is none at all."""
        paths = [folder.checkpoints for folder in self.folders]
        for path in paths:
            checkpoint.clean(path)
        like = jax.eval_shape(lambda: self.program.init(0))
        restored = checkpoint.restore(paths, like)
        if restored is None:
            return None
        for damage in restored.damaged:
            aside = checkpoint.set_aside(damage)
            self.report.warn(
                f"checkpoint {damage.path} is damaged ({damage.reason}; kept as {aside.name}): "
                f"using the one of iteration {restored.iteration}"
            )
        self.done = restored.iteration
        return stack(restored.states)

    def open_logs(self, columns: list[str] | None) -> None:
        """Opens the CSV files and TensorBoard events of all seeds, without rows after the current iteration."""
        if not self.hosts.is_first:
            return
        self.recorders = [Recorder(folder, columns, start=self.done, warn=self.report.warn) for folder in self.folders]
        self.evaluated = self.recorders[0].last_evaluation()

    def compile_step(self, state: Any) -> tuple[Callable[[Any], tuple[Any, Any]], list[str]]:
        """The compiled train step, which consumes its argument, and the names of its metrics."""
        step = self.program.jit(self._vmap(self.program.step), donate_argnums=0)

        def compile_it() -> tuple[Any, Any]:
            lowered = step.lower(state)
            return lowered.compile(), lowered.out_info[1]

        with self.report.phase("compiling the train step") as tick:
            compiled, metrics = self.interrupts.call(compile_it, finish=self.hosts.number > 1, tick=tick)
        if lack := shortage(compiled, self.config):
            raise RunError(lack)
        zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), metrics)
        return compiled, list(metric_rows(zeros, len(self.seeds))[0])

    def evaluate(self, state: Any, episodes: int, *, final: bool = False) -> list[Evaluation]:
        """Success on rho_0 now; written to every seed's eval.csv.

        Args:
            state: what to evaluate.
            episodes: of each policy.
            final: keep each episode's outcome, too.

        Returns:
            Of each seed in the first process, none in the others.

        Raises:
            Interrupted: asked to stop meanwhile; nothing is written.
        """
        keys = self.program.devices.placed(stack([evaluation_key(seed, self.done) for seed in self.seeds]))
        if episodes not in self._evaluate:
            jitted = self.program.jit(self._vmap(self.program.make_evaluate(episodes)))
            with self.report.phase(f"compiling the evaluation of {episodes} episodes") as tick:
                self._evaluate[episodes] = self.interrupts.call(
                    lambda: jitted.lower(state, keys).compile(), finish=self.hosts.number > 1, tick=tick
                )
        run = self._evaluate[episodes]
        result = jax.device_get(self.program.devices.local(self._compute(lambda: run(state, keys))))
        columns = [
            np.asarray(each).reshape(len(self.seeds))
            for each in (result.successes_stochastic, result.successes_mean, result.episodes)
        ]
        if final and self.hosts.is_first:
            for recorder, rows in zip(self.recorders, outcome_rows(result, len(self.seeds)), strict=True):
                recorder.write_outcomes([(self.done, *row) for row in rows])
        evaluations = []
        for k, recorder in enumerate(self.recorders):
            stochastic, mean, number = (int(column[k]) for column in columns)
            evaluation = Evaluation(self.done, recorder.env_steps, stochastic, mean, number, self.program.starts_sha256)
            recorder.add_evaluation(evaluation.row(self.program.interval))
            evaluations.append(evaluation)
        self.evaluated = self.done, float(np.mean([each.success_stochastic for each in evaluations] or [0.0]))
        return evaluations

    def has_evaluation(self, episodes: int) -> bool:
        """Whether every seed has an evaluation of at least so many episodes after the current iteration."""
        found = self.hosts.is_first and all(has_evaluation(folder, self.done, episodes) for folder in self.folders)
        return bool(self.told(np.bool_(found)))

    def save(self, state: Any) -> None:
        """Saves all seeds; a failure is a warning, and :attr:`saved` stays as it was."""
        if not self.hosts.is_first:
            self.saved = self.done
            return
        for recorder in self.recorders:
            recorder.flush()
        if not all(recorder.complete for recorder in self.recorders):
            return
        try:
            states = unstack(self.program.devices.local(state), len(self.seeds))
            checkpoint.save([folder.checkpoints for folder in self.folders], self.done, states)
            self.saved = self.done
        except checkpoint.CheckpointWriteError as error:
            self.report.warn(f"no checkpoint at iteration {self.done}: {error}; the next iteration tries again")

    def _record_starts(self, state: Any) -> None:
        """Writes the starts of the iteration that ended in ``state``."""
        if not self.hosts.is_first:
            return
        starts = jax.device_get(self.program.starts(self.program.devices.local(state)))
        for recorder, (each, labels) in zip(self.recorders, unstack(starts, len(self.seeds)), strict=True):
            recorder.add_starts(start_row(self.done, each, labels))

    def _record(self, metrics: Any, seconds: float, wall_s: float) -> None:
        """Writes and shows one iteration."""
        if not self.hosts.is_first:
            return
        rows = metric_rows(jax.device_get(self.program.devices.local(metrics)), len(self.seeds))
        rates = []
        for row, recorder in zip(rows, self.recorders, strict=True):
            per_iteration = row["env_steps"]
            assert isinstance(per_iteration, int)
            # Whole episodes make iterations differ. Where the rows before are lost, they were like this one.
            before = recorder.env_steps or per_iteration * (self.done - 1)
            env_steps = row["env_steps"] = before + per_iteration
            rates.append((env_steps - recorder.env_steps) / seconds)
            recorder.env_steps = env_steps
            recorder.add_metrics({**row, **dict(zip(WALL_CLOCK, (recorder.wall_s + wall_s, rates[-1]), strict=True))})

        def mean(name: str) -> float:
            return float(np.mean([float(row.get(name) or 0.0) for row in rows]))

        self._tell_nonfinite(rows)
        shown = Progress(
            iteration=self.done,
            env_steps=int(mean("env_steps")),
            steps_per_s=sum(rates),
            success=mean("success"),
            share_good=mean("share_good"),
            start_distance=mean("start_distance"),
            evaluated=self.evaluated,
        )
        self.report.iteration(shown, seconds)

    def _tell_nonfinite(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """A warning, once, where numbers turned non-finite; an end where they always do.

        Raises:
            RunError: no episode of the iteration ended otherwise.
        """
        count = int(sum(row.get("nonfinite") or 0 for row in rows))
        episodes = int(sum(row.get("episodes") or 0 for row in rows))
        if not count:
            return
        what = "physics or what the task computes from it (observe, distance)"
        if count >= episodes > 0 and not any(row.get("success") for row in rows):
            raise RunError(f"iteration {self.done}: {what} turned non-finite in all of its episodes")
        if not self._told_nonfinite:
            self._told_nonfinite = True
            self.report.warn(
                f"iteration {self.done}: {count} of about {max(count, episodes)} episodes ended as failures, because "
                f"{what} turned non-finite; later ones are counted in metrics.csv, nonfinite"
            )

    def _due(self, every: int) -> bool:
        return every > 0 and self.done % every == 0 and self.done < self.config.iterations

    def train(self, state: Any) -> Any:
        """Iterates until the configured number, or until asked to stop; returns the last state, which is saved.

        Raises:
            Interrupted: asked to stop; the state is saved.
        """
        config = self.config
        step, columns = self.compile_step(state)
        self.open_logs(columns)
        begin = time.monotonic()
        self.report.begin(self.done, config.iterations)
        # A kill can come between a checkpoint and its evaluation.
        if self.done > 0 and self._due(config.eval_every) and not self.has_evaluation(config.evaluation.episodes):
            self.evaluate(state, config.evaluation.episodes)
        while self.done < config.iterations:
            start = time.monotonic()
            state, metrics = self._compute(partial(step, state), finish=True)
            self.done += 1
            now = time.monotonic()
            self._record(metrics, now - start, now - begin)
            self._record_starts(state)
            stopped = self._compute(lambda: self.hosts.any_signal(self.interrupts.signum), finish=True)
            if stopped is None and self._due(config.eval_every):
                try:
                    self.evaluate(state, config.evaluation.episodes)
                except Interrupted as interrupted:
                    stopped = interrupted.signum
            last_save = self.done // config.checkpoint_every * config.checkpoint_every
            if stopped is not None or self.done == config.iterations or self.saved < last_save:
                self.save(state)
            if stopped is not None:
                raise Interrupted(stopped)
        return state

    def finish(self, state: Any) -> None:
        """Final evaluation, summary, policy file, pictures and report."""
        config = self.config
        evaluations = self.evaluate(state, config.evaluation.final_episodes, final=True)
        self.save_late(state)
        if not self.hosts.is_first:
            return
        states = unstack(self.program.devices.local(state), len(self.seeds))
        for folder, recorder, own, each in zip(self.folders, self.recorders, states, evaluations, strict=True):
            low, high = self.program.interval(each.successes_stochastic, each.episodes)
            self.report.say(
                f"{folder.path}: iteration {self.done}, {each.env_steps / 1e6:.2f}M steps, success on rho_0 "
                f"{each.success_stochastic:.3f} [{low:.3f}, {high:.3f}] (mean action {each.success_mean:.3f}), "
                f"{each.episodes} episodes"
            )
            recorder.flush()
            write_products(self.program, folder, own, each, self.report)
        if config.write_report:
            for folder in self.folders:
                write_report(self.program, folder, self.report, self.interrupts)

    def save_late(self, state: Any) -> None:
        """A last attempt, where a full disk kept the end of the run from being saved.

        Raises:
            RunError: it still cannot be saved.
        """
        if self.saved < self.done:
            self.save(state)
        if self.saved < self.done:
            raise RunError(f"iterations {self.saved + 1} to {self.done} could not be saved; make room and run again")
