"""All runs behind the paper's curves, from one command that can be stopped and given again.

    python -m experiments.reproduce budget=cpu                   # trains what is missing, then collects it
    python -m experiments.reproduce budget=cpu plan=table        # what there is, what is missing, how long it takes
    python -m experiments.reproduce budget=cpu plan=commands     # the missing runs, one command a line
    python -m experiments.reproduce budget=cpu plan=sweeps       # the same for Hydra's launchers (several machines)
    python -m experiments.reproduce task=ring_peg method=reverse,uniform seed=0,1

Finished runs are skipped, broken ones go on at their last checkpoint, one that fails does not stop the others. Two of
these commands on one file system share the work: each leaves alone what the other is training. ``docs/reproduce.md``
has times, and how to split the work over machines.
"""

from __future__ import annotations

import dataclasses
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments import provenance
from experiments.collect import collect
from experiments.live import Display, last_line, watch
from experiments.plan import BUDGETS, SEEDS, Budget, Curve, Member, members, words
from experiments.report import RESULTS, in_one_line, options
from experiments.states import Estimates, State, state
from rcg_jax.config.names import METHODS, TASKS
from rcg_jax.config.settings import ConfigError, option
from rcg_jax.runs.progress import duration


@dataclass(frozen=True)
class ReproduceOptions:
    """Settings of ``python -m experiments.reproduce``."""

    budget: str = option("cpu", "machine that the runs are meant for", choices=tuple(BUDGETS))
    plan: str = option(
        "no",
        "no: train; table: what there is and what is missing; commands, sweeps: print how to train it elsewhere",
        choices=("no", "table", "commands", "sweeps"),
    )
    task: str = option("all", "tasks, separated by commas")
    method: str = option("all", "methods, separated by commas")
    reward: str = option("all", "sparse or distance", choices=("all", "sparse", "distance"))
    preset: str = option("all", "default or paper", choices=("all", "default", "paper"))
    seed: str = option(",".join(map(str, SEEDS)), "seeds, separated by commas")
    together: str = option(
        "budget",
        "whether the seeds of a curve are one vmapped program; budget: on an accelerator, not on a CPU, where it is "
        "1.5 times faster in all but the curves come late",
        choices=("budget", "yes", "no"),
    )
    settings: str = option(
        "none", "further settings of every run, separated by spaces, or none; give such runs a run_dir of their own"
    )
    run_dir: str = option("runs/reproduce", "folder of the runs")
    out: str = option(str(RESULTS), "folder of the CSV files that are collected at the end")
    launcher: str = option("joblib", "of plan=sweeps: joblib, submitit_slurm, or another one of Hydra's")


def _names(field: str, text: str, allowed: Sequence[str]) -> tuple[str, ...]:
    """A list of the command line.

    Raises:
        ConfigError: one of its names is unknown.
    """
    if text == "all":
        return tuple(allowed)
    for name in text.split(","):
        if name not in allowed:
            raise ConfigError(f"{field}={text}: {name} is none of {', '.join(allowed)}")
    return tuple(text.split(","))


def _seeds(text: str) -> list[int]:
    if not all(word.isdecimal() for word in text.split(",")):
        raise ConfigError(f"seed={text}: must be numbers >= 0, separated by commas")
    return [int(word) for word in text.split(",")]


def chosen_budget(chosen: ReproduceOptions) -> Budget:
    """The budget asked for."""
    budget = BUDGETS[chosen.budget]
    return budget if chosen.together == "budget" else dataclasses.replace(budget, together=chosen.together == "yes")


def selection(chosen: ReproduceOptions) -> list[Curve]:
    """The curves asked for.

    Raises:
        ConfigError: an unknown name, or no curve is left.
    """
    tasks, methods = _names("task", chosen.task, TASKS), _names("method", chosen.method, METHODS)
    curves = [
        curve
        for curve in BUDGETS[chosen.budget].curves
        if curve.task in tasks
        and curve.method in methods
        and chosen.reward in ("all", curve.reward)
        and chosen.preset in ("all", curve.preset)
    ]
    if not curves:
        raise ConfigError(
            f"budget={chosen.budget} task={chosen.task} method={chosen.method} reward={chosen.reward} "
            f"preset={chosen.preset}: the figures need no such curve"
        )
    return curves


def _about(seconds: float | None) -> str:
    return "?" if seconds is None else duration(seconds)


def table(plan: Sequence[Member], states: Sequence[State], estimates: Estimates) -> str:
    """The plan in words: a line per member, and the sum."""
    rows = [("run", "state", "to do", "an iteration", "")]
    for member, now in zip(plan, states, strict=True):
        seconds, how = estimates.seconds(member.curve, member.config.num_seeds)
        per = "?" if seconds is None else f"{seconds:.1f} s"
        left = "-" if now.finished or now.conflict else _about(estimates.left(member, now))
        rows.append((member.name, now.words(member.config.iterations), left, per, how if seconds else "not measured"))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows]
    lines.append(summary(plan, states, estimates))
    for member, now in zip(plan, states, strict=True):
        if now.conflict:
            lines.append(f"{member.name}: {now.conflict}")
    return "\n".join(lines)


def time_left(plan: Sequence[Member], states: Sequence[State], estimates: Estimates) -> str:
    """Of all members; with a mark where some of it is not known."""
    parts = [estimates.left(member, now) for member, now in zip(plan, states, strict=True)]
    known = duration(sum(part for part in parts if part is not None))
    return known if None not in parts else f"more than {known}" if any(parts) else "?"


def summary(plan: Sequence[Member], states: Sequence[State], estimates: Estimates) -> str:
    """One line; those that failed are not among what is left."""
    finished, failed = sum(now.finished for now in states), len(estimates.skipped)
    words = f"{finished} of {len(plan)} runs finished" + (f", {failed} failed" if failed else "")
    if finished + failed >= len(plan):
        return words
    return f"{words}, {time_left(plan, states, estimates)} left on one such machine"


def sweeps(chosen: ReproduceOptions, budget: Budget, curves: Sequence[Curve], extra: Sequence[str]) -> list[str]:
    """One ``-m`` command for all methods and seeds of each task, reward and preset."""
    groups: dict[tuple[str, str, str], list[Curve]] = {}
    for curve in curves:
        groups.setdefault((curve.task, curve.reward, curve.preset), []).append(curve)
    seeds = sorted(set(_seeds(chosen.seed)))
    together = budget.together and seeds == list(range(seeds[0], seeds[0] + len(seeds)))
    last = f"seed={seeds[0]} num_seeds={len(seeds)}" if together else f"seed={','.join(map(str, seeds))}"
    lines = []
    for group in groups.values():
        methods = ",".join(curve.method for curve in group)
        own = words(budget, group[0], Path(chosen.run_dir) / chosen.budget, method=methods, seeds=last, extra=extra)
        line = ["python", "-m", "rcg_jax.run", "-m", f"hydra/launcher={chosen.launcher}"]
        lines.append(shlex.join([*line, *" ".join(own).split()]))
    return lines


def _stop(process: subprocess.Popen) -> None:
    """Tells a member to save and end, and waits for it; told again, it ends at once."""
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait()
        except KeyboardInterrupt:
            continue


def run_member(member: Member, log: Path, show: Callable[[str], None]) -> int:
    """Runs a member to its end; returns its exit code.

    Args:
        member: what to run.
        log: file that its output is added to.
        show: told its last line now and then.

    Raises:
        KeyboardInterrupt: asked to stop; the member has saved and ended.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    done = state(member).done
    with log.open("ab") as out:
        begin = out.tell()
        # In a session of its own: a Ctrl-C on the terminal must reach it once, through this process.
        process = subprocess.Popen(
            member.command, stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True
        )
        try:
            code = watch(process, log, begin, show)
        except KeyboardInterrupt:
            show("saving; once more stops at once")
            _stop(process)
            raise
        finally:
            with log.open("rb") as text:
                text.seek(begin)
                device = provenance.device_of(text.read().decode(errors="replace"))
            present = [folder.path for folder in member.folders if folder.metrics_file.exists()]
            if device and present:
                provenance.record(present, provenance.describe(device, len(member.folders)), done)
    return code


def train(plan: Sequence[Member], estimates: Estimates, logs: Path) -> int:
    """Runs what is not finished; returns the number of members that failed.

    Raises:
        KeyboardInterrupt: asked to stop; everything is saved.
    """
    states = [state(member) for member in plan]
    failed: list[tuple[Member, str]] = []
    with Display() as display:
        for k, member in enumerate(plan):
            now = states[k] = state(member)
            if now.finished:
                continue
            if now.conflict or now.busy:
                display.say(f"{member.name}: {now.conflict or 'another process is training it; left to that'}")
                if now.conflict:
                    failed.append((member, "the folder holds a run with other settings"))
                    estimates.skip(member)
                continue
            log = logs / f"{member.name.replace(' ', '_').replace('=', '-')}.log"

            def show(line: str, k: int = k, member: Member = member) -> None:
                states[k] = state(member)
                estimates.learn(member)
                done = summary(plan, states, estimates).removesuffix(" on one such machine")
                display.show(done, f"{member.name}: {line}")

            display.say(f"[{k + 1}/{len(plan)}] {member.shown}")
            show("starting")
            code = run_member(member, log, show)
            states[k] = state(member)
            estimates.learn(member)
            if code and states[k].busy:
                display.say(f"{member.name}: another process began it meanwhile; left to that")
            elif code or not states[k].finished:
                reason = last_line(log)
                display.say(f"failed with exit code {code}: {member.name}: {reason} (all of it: {log})")
                failed.append((member, reason))
                estimates.skip(member)
            else:
                display.say(last_line(log))
    print(summary(plan, states, estimates))
    for member, reason in failed:
        print(f"failed: {member.name}: {reason}\n  resume with: {member.shown}")
    return len(failed)


@in_one_line
def main() -> int:
    """Plans, trains, collects; returns the exit code: 1 if a run failed, 2 for wrong settings, 130 stopped."""
    chosen = options(ReproduceOptions, "experiments.reproduce")
    budget, root = chosen_budget(chosen), Path(chosen.run_dir) / chosen.budget
    extra = [] if chosen.settings == "none" else chosen.settings.split()
    try:
        curves = selection(chosen)
        plan = members(budget, curves, _seeds(chosen.seed), root, extra)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if chosen.plan == "sweeps":
        print("\n".join(sweeps(chosen, budget, curves, extra)))
        return 0
    estimates, states = Estimates.of(budget, plan, Path(chosen.out)), [state(member) for member in plan]
    if chosen.plan == "table":
        print(table(plan, states, estimates))
        return 0
    if chosen.plan == "commands":
        print("\n".join(member.shown for member, now in zip(plan, states, strict=True) if not now.finished))
        return 0
    print(summary(plan, states, estimates), flush=True)
    for signum in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(signum) == signal.SIG_DFL:  # nohup keeps what it ignores
            signal.signal(signum, signal.default_int_handler)
    try:
        failures = train(plan, estimates, root / "logs")
    except KeyboardInterrupt:
        collect(root, Path(chosen.out))
        print(f"stopped; resume with: {shlex.join(['python', '-m', 'experiments.reproduce', *sys.argv[1:]])}")
        return 130
    found = collect(root, Path(chosen.out))
    _measure_policies(plan, root, chosen)
    if found:
        elsewhere = Path(chosen.out).resolve() != RESULTS.resolve()
        words = " " + shlex.quote(f"ARGS=results={chosen.out}") if elsewhere else ""
        print(f"make figures{words} draws them")
    return 1 if failures else 0


def _measure_policies(plan: Sequence[Member], root: Path, chosen: ReproduceOptions) -> None:
    """The maps of figure B.2, if their runs are among these; in a process of their own, which imports JAX."""
    from experiments.uniform_failure import METHODS as MAPPED

    if any(
        member.curve in [Curve("point_maze", name) for name in MAPPED] and state(member).finished for member in plan
    ):
        command = [sys.executable, "-m", "experiments.uniform_failure", f"run_dir={root}", f"results={chosen.out}"]
        subprocess.run(command, check=False)


if __name__ == "__main__":
    sys.exit(main())
