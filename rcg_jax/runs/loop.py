"""The parts of a run: resume, compile, iterate, evaluate, save. All side effects of training are here."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import numpy as np

import rcg_jax
from rcg_jax.config.settings import Config
from rcg_jax.runs import checkpoint
from rcg_jax.runs.folder import RunFolder
from rcg_jax.runs.interrupt import Interrupted, Interrupts
from rcg_jax.runs.memory import shortage
from rcg_jax.runs.program import Program
from rcg_jax.runs.progress import Progress, Reporter
from rcg_jax.runs.recorder import WALL_CLOCK, Evaluation, Recorder, has_evaluation
from rcg_jax.runs.seeds import evaluation_key, metric_rows, outcome_rows, stack, strong, unstack
from rcg_jax.runs.start_record import start_row
from rcg_jax.sharding.hosts import Hosts

#: A seed's folder, its last state, and its final evaluation.
Finished = tuple[RunFolder, Any, Evaluation]


class RunError(RuntimeError):
    """A run cannot start or go on; the message is one line."""


@dataclass
class Loop:
    """One run of S seeds in one program. Of several processes, only the first one reads and writes.

    Attributes:
        folders: of the seeds; open in the first process.
        saved: the last iteration with a checkpoint; 0: none.
    """

    config: Config
    program: Program
    folders: Sequence[RunFolder]
    report: Reporter
    interrupts: Interrupts
    hosts: Hosts
    saved: int = 0
    _done: int = 0
    _recorders: list[Recorder] = field(default_factory=list)
    _evaluated: tuple[int, float] | None = None
    _told_nonfinite: bool = False
    _evaluate: dict[int, Callable[..., Any]] = field(default_factory=dict)

    def run(self) -> list[Finished]:
        """From the newest intact checkpoint, or a new state, to the end and a final evaluation.

        Returns:
            What is new, of each seed, in the first process.

        Raises:
            CheckpointError: there are checkpoints, but none is intact.
            Interrupted: asked to stop; the state is saved.
            RunError: it cannot go on.
        """
        state, config, report = self._start(), self.config, self.report
        finished = self._done == config.iterations and self._has_evaluation(config.evaluation.final_episodes)
        if self._done > config.iterations or finished:
            report.say(f"the run is complete: {self._done} of {config.iterations} iterations are done")
            return []
        for folder in self.folders if self.hosts.is_first else []:
            folder.write_config()
        if self._done:
            report.say(f"resuming from iteration {self._done} of {config.iterations}")
        if self._done < config.iterations:
            state = self._train(state)
            report.end()
        else:
            self._open_logs(None)
        return self._finish(state)

    def close(self) -> None:
        """Closes the logs."""
        for recorder in self._recorders:
            recorder.close()

    def _compute(self, fun: Callable[[], Any], *, finish: bool = False) -> Any:
        # No process leaves a computation that the others are in.
        return self.interrupts.call(
            lambda: jax.block_until_ready(fun()), finish=finish or self.hosts.number > 1, tick=self.report.tick
        )

    def _compile(self, what: str, fun: Callable[..., Any], *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """``fun`` of all seeds, compiled for ``args``, and the shapes of its results."""
        jitted = self.program.jit(fun if len(self.folders) == 1 else self.program.devices.vmap(fun), **kwargs)

        def compile_it() -> tuple[Any, Any]:
            lowered = jitted.lower(*args)
            return lowered.compile(), lowered.out_info

        with self.report.phase(f"compiling {what}") as tick:
            return self.interrupts.call(compile_it, finish=self.hosts.number > 1, tick=tick)

    def _told(self, value: Any) -> Any:
        """The first process's ``value``, in all of them."""
        return self._compute(lambda: self.hosts.told(value))

    def _start(self) -> Any:
        """The state to continue from: the newest intact checkpoint, or a new one."""
        state = self._restore() if self.hosts.is_first else None
        self._done = self.saved = int(self._told(np.int32(self._done)))
        if state is None:
            # Compiled as a whole: one by one, its many small operations take longer.
            init = jax.jit(self.program.init)
            state = self._compute(lambda: strong(stack([init(each.config.seed) for each in self.folders])))
        return self.program.devices.placed(self._told(state))

    def _restore(self) -> Any | None:
        """The newest intact checkpoint; None where there is none at all."""
        paths = [folder.checkpoints for folder in self.folders]
        for path in paths:
            checkpoint.clean(path)
        restored = checkpoint.restore(paths, jax.eval_shape(lambda: self.program.init(0)))
        if restored is None:
            return None
        for damage in restored.damaged:
            aside = checkpoint.set_aside(damage)
            self.report.warn(
                f"checkpoint {damage.path} is damaged ({damage.reason}; kept as {aside.name}): "
                f"using the one of iteration {restored.iteration}"
            )
        self._done = restored.iteration
        return stack(restored.states)

    def _open_logs(self, columns: list[str] | None) -> None:
        """Opens the CSV files and TensorBoard events of all seeds, without rows after the current iteration."""
        if self.hosts.is_first:
            for each in self.folders:  # one that is open is closed, whatever becomes of the next
                self._recorders.append(Recorder(each, columns, start=self._done, warn=self.report.warn))
            self._evaluated = self._recorders[0].evaluated

    def _train(self, state: Any) -> Any:
        """Iterates until the configured number, or until asked to stop; returns the last state, which is saved."""
        config, episodes = self.config, self.config.evaluation.episodes
        step, (_, metrics) = self._compile("the train step", self.program.step, state, donate_argnums=0)
        if lack := shortage(step, config):
            raise RunError(lack)
        zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), metrics)
        self._open_logs(list(metric_rows(zeros, len(self.folders))[0]))
        begin = time.monotonic()
        self.report.begin(self._done, config.iterations)
        # A kill can come between a checkpoint and its evaluation.
        if self._done > 0 and self._due(config.eval_every) and not self._has_evaluation(episodes):
            self._measure(state, episodes)
        while self._done < config.iterations:
            start = time.monotonic()
            state, metrics = self._compute(partial(step, state), finish=True)
            self._done += 1
            now = time.monotonic()
            self._record(state, metrics, now - start, now - begin)
            stopped = self._compute(lambda: self.hosts.any_signal(self.interrupts.signum), finish=True)
            if stopped is None and self._due(config.eval_every):
                try:
                    self._measure(state, episodes)
                except Interrupted as interrupted:
                    stopped = interrupted.signum
            last_save = self._done // config.checkpoint_every * config.checkpoint_every
            if stopped is not None or self._done == config.iterations or self.saved < last_save:
                self._save(state)
            if stopped is not None:
                raise Interrupted(stopped)
        return state

    def _due(self, every: int) -> bool:
        return every > 0 and self._done % every == 0 and self._done < self.config.iterations

    def _record(self, state: Any, metrics: Any, seconds: float, wall_s: float) -> None:
        """Writes and shows one iteration."""
        if not self.hosts.is_first:
            return
        local, num_seeds = self.program.devices.local, len(self.folders)
        rows = metric_rows(jax.device_get(local(metrics)), num_seeds)
        for row, recorder in zip(rows, self._recorders, strict=True):
            per_iteration = row["env_steps"]
            assert isinstance(per_iteration, int)
            # Whole episodes make iterations differ. Where the rows before are lost, they were like this one.
            before = recorder.env_steps or per_iteration * (self._done - 1)
            recorder.env_steps = row["env_steps"] = before + per_iteration
            row |= dict(zip(WALL_CLOCK, (recorder.wall_s + wall_s, per_iteration / seconds), strict=True))
            recorder.add_metrics(row)
        self._check_finite(rows)
        starts = jax.device_get(self.program.starts(local(state)))
        for recorder, (each, labels) in zip(self._recorders, unstack(starts, num_seeds), strict=True):
            recorder.add_starts(start_row(self._done, each, labels))

        def mean(name: str) -> float:
            return float(np.mean([float(row.get(name) or 0.0) for row in rows]))

        shown = Progress(
            iteration=self._done,
            env_steps=int(mean("env_steps")),
            steps_per_s=mean("steps_per_s") * num_seeds,
            success=mean("success"),
            share_good=mean("share_good"),
            start_distance=mean("start_distance"),
            evaluated=self._evaluated,
        )
        self.report.iteration(shown, seconds)

    def _check_finite(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """A warning, once, where numbers turned non-finite; an end where they always do."""
        count = int(sum(row.get("nonfinite") or 0 for row in rows))
        episodes = int(sum(row.get("episodes") or 0 for row in rows))
        what = "physics or what the task computes from it (observe, distance)"
        if count and count >= episodes > 0 and not any(row.get("success") for row in rows):
            raise RunError(f"iteration {self._done}: {what} turned non-finite in all of its episodes")
        if count and not self._told_nonfinite:
            self._told_nonfinite = True
            self.report.warn(
                f"iteration {self._done}: {count} of about {max(count, episodes)} episodes ended as failures, because "
                f"{what} turned non-finite; later ones are counted in metrics.csv, nonfinite"
            )

    def _has_evaluation(self, episodes: int) -> bool:
        """Whether every seed has an evaluation of at least so many episodes after the current iteration."""
        found = self.hosts.is_first and all(has_evaluation(folder, self._done, episodes) for folder in self.folders)
        return bool(self._told(np.bool_(found)))

    def _measure(self, state: Any, episodes: int, *, final: bool = False) -> list[Evaluation]:
        """Success on rho_0 now, written to every seed's eval.csv; if ``final``, each episode's outcome is kept, too.

        Returns those of all seeds in the first process, none in the others. Interrupted, it writes nothing.
        """
        keys = [evaluation_key(folder.config.seed, self._done) for folder in self.folders]
        keys = self.program.devices.placed(stack(keys))
        if episodes not in self._evaluate:
            self._evaluate[episodes], _ = self._compile(
                f"the evaluation of {episodes} episodes", self.program.make_evaluate(episodes), state, keys
            )
        run = self._evaluate[episodes]
        result = jax.device_get(self.program.devices.local(self._compute(lambda: run(state, keys))))
        if not self.hosts.is_first:
            return []
        numbers = (result.successes_stochastic, result.successes_mean, result.episodes)
        counts = np.stack(numbers).reshape(3, len(self.folders))
        rows = outcome_rows(result, len(self.folders))
        evaluations = []
        for recorder, own, (good, good_mean, number) in zip(self._recorders, rows, counts.T.tolist(), strict=True):
            if final:
                recorder.write_outcomes([(self._done, *row) for row in own])
            sha256 = self.program.starts_sha256
            evaluation = Evaluation(self._done, recorder.env_steps, good, good_mean, number, sha256)
            of_seed = f"seed {recorder.folder.config.seed}: " if len(self.folders) > 1 else ""
            for reached in recorder.add_evaluation(evaluation, time.monotonic() - rcg_jax.STARTED):
                self.report.say(f"{of_seed}{reached}")
            evaluations.append(evaluation)
        self._evaluated = self._done, float(np.mean(counts[0] / counts[2]))
        return evaluations

    def _save(self, state: Any) -> None:
        """Saves all seeds; a failure is a warning, and :attr:`saved` stays as it was."""
        for recorder in self._recorders:
            recorder.flush()
        if not all(recorder.complete for recorder in self._recorders):
            return
        try:
            if self.hosts.is_first:
                states = unstack(self.program.devices.local(state), len(self.folders))
                checkpoint.save([folder.checkpoints for folder in self.folders], self._done, states)
            self.saved = self._done
        except checkpoint.CheckpointWriteError as error:
            self.report.warn(f"no checkpoint at iteration {self._done}: {error}; the next iteration tries again")

    def _finish(self, state: Any) -> list[Finished]:
        """Final evaluation of the last state, which must be saved."""
        evaluations = self._measure(state, self.config.evaluation.final_episodes, final=True)
        if self.saved < self._done:  # a last attempt, where the disk was full
            self._save(state)
        if self.saved < self._done:
            raise RunError(f"iterations {self.saved + 1} to {self._done} could not be saved; make room and run again")
        for recorder in self._recorders:
            recorder.flush()
        states = unstack(self.program.devices.local(state), len(self.folders)) if evaluations else []
        return list(zip(self.folders, states, evaluations))
