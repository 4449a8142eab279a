"""Every setting of a run, once: its default, meaning, unit, paper symbol and allowed values.

The dataclasses below are the only place where defaults live. ``python -m rcg_jax.run --help`` prints them;
what a task or a preset trains with instead is in :mod:`rcg_jax.config.presets`. :mod:`rcg_jax.config.validate` checks
the values of a run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from rcg_jax.config.names import ENGINES


class ConfigError(ValueError):
    """A setting that cannot be used. The message is one line: field, value, what is allowed."""


#: What may be known of a setting besides its default and meaning.
_ABOUT = {"unit": "", "symbol": "", "low": None, "high": None, "above": None, "choices": (), "pattern": "", "form": ""}


def option(default: Any, help: str, **about: Any) -> Any:
    """A dataclass field with its documentation and range.

    Args:
        default: default value; a list is copied for each instance.
        help: one sentence.
        about: physical ``unit``; the paper's ``symbol``; inclusive bounds ``low`` and ``high``; an exclusive one,
            ``above``; allowed strings, ``choices``; a regular expression for all of a string, ``pattern``, and the
            same in words, ``form``.
    """
    assert about.keys() <= _ABOUT.keys(), about
    metadata = {"help": help, **_ABOUT, **about}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def count(default: Any, help: str, **more: Any) -> Any:
    """An :func:`option` >= 1."""
    return option(default, help, low=1, **more)


def share(default: float, help: str, **more: Any) -> Any:
    """An :func:`option` from 0 to 1."""
    return option(default, help, low=0, high=1, **more)


#: Action noise of walks, and how new starts are chosen among what they visited, see :func:`rcg_jax.sample_nearby`.
NOISES = ("white", "integrated")
SELECTIONS = ("random", "spread")

#: How exact float32 matrix products are on an accelerator, see :func:`rcg_jax.physics.jit.jit`.
MATMUL_PRECISIONS = ("float32", "tensorfloat32", "default")


@dataclass(frozen=True)
class CurriculumConfig:
    """Reverse curriculum: Algorithm 1, Procedure 1."""

    num_new: int = count(60, "new starts per iteration, found by sample_nearby", symbol="N_new", high=10**7)
    num_old: int = option(30, "starts per iteration drawn from the replay", symbol="N_old", low=0, high=10**7)
    num_candidates: int = count(2_500, "states that the walks of an iteration collect", symbol="M", high=10**9)
    brownian_horizon: int = count(50, "length of a Brownian walk", unit="steps", symbol="T_B")
    brownian_horizon_max: int = count(
        400, "walks lengthen up to this (grow_above, grow_below); brownian_horizon: T_B is fixed", unit="steps"
    )
    growth: float = count(1.3, "factor by which walks lengthen or shorten from one iteration to the next")
    grow_above: float = share(0.7, "they lengthen while more of the starts are mastered")
    grow_below: float = share(0.1, "where episodes can fail they also lengthen while fewer starts are too hard")
    shrink_above: float = share(0.5, "they shorten while more of the starts are too hard")
    selection: str = option(
        "spread", "which of these become new starts; random: any (the paper); spread: far apart", choices=SELECTIONS
    )
    rho_0_share: float = share(
        0.0, "guidance by S^0: share of the new starts that are states visited nearest to draws of rho_0; 0: the paper"
    )
    value_share: float = share(0.5, "of spread starts, the share that is spread over V(s)")
    walk_rounds: int = count(1, "rounds of walks, each also from what earlier ones visited (the paper: one walk each)")
    noise_std: float = option(1.0, "standard deviation of the action noise of a walk", symbol="Sigma^(1/2)", above=0)
    noise: str = option(
        "integrated", "white: a_t = eps_t (the paper's text); integrated: a_t = a_(t-1) + eps_t", choices=NOISES
    )
    r_min: float = share(0.1, "starts solved less often are too hard", symbol="R_min")
    r_max: float = share(0.9, "starts solved more often are mastered", symbol="R_max")
    min_episodes: int = count(2, "finished episodes needed to label a start")
    min_good: float = share(0.1, "share of good starts under which others become seeds, too (0: when none is good)")
    outward_share: float = option(
        0.25, "then, if most are mastered: share of the mastered new starts, farthest first (1: all)", above=0, high=1
    )
    stall_walk: int = option(
        0, "walks from all starts that find seeds if none is good, most mastered (the authors': 10)", unit="T", low=0
    )
    stall_walks: int = count(2, "how many such walks, side by side (the authors' code: one per process)")
    replay_distance: float = option(
        0.0, "least distance of a start from all in the replay to enter it (the authors': 0.03)", unit="rad, m", low=0
    )
    replay_capacity: int = count(10_000, "starts kept in the replay; beyond it random ones are replaced", high=10**9)


@dataclass(frozen=True)
class RolloutConfig:
    """Environments stepped side by side."""

    batch: str = option(
        "segments",
        "what a TRPO iteration trains on; episodes: whole episodes, at least batch_size steps of them, nothing after T "
        "(the authors' software); segments: environments go on where the last iteration cut them, V follows a cut",
        choices=("segments", "episodes"),
    )
    value_at_horizon: bool = option(
        True, "of segments: V also follows where an episode runs out of time (partial-episode bootstrapping)"
    )
    num_envs: int = option(
        0,
        "environments of one rollout; 0: 400, or fewer so that an iteration holds 2 horizons (a batch of episodes: 3) "
        "and devices share them evenly",
        symbol="N",
        low=0,
        high=10**8,
    )
    batch_size: int = option(
        0,
        "physics steps per TRPO iteration, a multiple of num_envs times action_repeat; 0: 40 horizons, at least 20000",
        unit="steps",
        low=0,
        high=2**31 - 1,
    )


@dataclass(frozen=True)
class TrpoConfig:
    """Trust region policy optimisation and advantages."""

    iterations: int = count(5, "TRPO iterations per curriculum iteration")
    max_kl: float = option(0.01, "trust region: mean KL of one update", unit="nats", symbol="delta", above=0)
    full_step_failures: float = share(
        0.1, "share of failed episodes below which the trust region shrinks in proportion, at most tenfold; 0: never"
    )
    gamma: float = option(0.998, "discount per physics step", symbol="gamma", above=0, high=1)
    gae_lambda: float = share(0.98, "generalised advantage estimation, per physics step", symbol="lambda")
    cg_iterations: int = count(10, "conjugate gradient iterations")
    cg_damping: float = option(1e-5, "added to the Fisher matrix's diagonal", low=0)
    fisher_fraction: float = option(
        0.05, "share of the batch in Fisher products, 1000 held actions at most (the KL bound: all)", above=0, high=1
    )
    step_scale: float = option(0.95, "first step tried, in radii of the quadratic model's region", above=0, high=1)
    saturation_penalty: float = option(
        0.3, "weight of the mean action's squared excess over the range [-1, 1] in the surrogate; 0: none", low=0
    )
    backtrack_ratio: float = option(0.8, "step shrinks by this in the line search", above=0, high=0.99)
    max_backtracks: int = count(15, "line search attempts")


@dataclass(frozen=True)
class PpoConfig:
    """algorithm=ppo: proximal policy optimisation. Iterations, discount, lambda and the penalty are those of trpo."""

    clip: float = option(0.2, "probability ratios beyond 1 +- this gain nothing", symbol="epsilon", above=0, high=0.99)
    epochs: int = count(10, "passes over the batch per iteration")
    minibatch_size: int = count(
        2_000, "physics steps per Adam step, a sample for each action; at most the batch", unit="steps"
    )
    learning_rate: float = option(3e-4, "Adam step size", above=0)
    max_grad_norm: float = option(0.5, "gradients are clipped to this norm", above=0)
    entropy: float = option(0.0, "weight of the policy's entropy", low=0)
    target_kl: float = option(0.03, "no further epoch beyond this mean KL; 0: never", unit="nats", low=0)


@dataclass(frozen=True)
class PolicyConfig:
    """Gaussian policy: tanh MLP mean, state-independent standard deviation."""

    hidden: list[int] = count([64, 64], "hidden layer widths; []: a linear policy")
    init_std: float = option(1.0, "initial standard deviation; actions span [-1, 1]", above=0, high=100)
    learn_std: bool = option(True, "train the standard deviation (false: it stays what it is initially)")
    action_repeat: int = count(
        1, "physics steps per action; S^0, T and walks stay in physics steps", unit="steps", symbol="k", high=1_000
    )
    output_gain: float = option(0.1, "scale of the output layer's initial weights", low=0)
    obs_norm_iterations: int = option(20, "iterations that update the observations' normalisation; 0: none", low=0)


@dataclass(frozen=True)
class BaselineConfig:
    """Value function V, fitted to lambda-returns."""

    hidden: list[int] = count([32, 32], "hidden layer widths")
    epochs: int = count(2, "passes over the batch per TRPO iteration")
    minibatch_size: int = count(
        5_000, "physics steps per Adam step, a sample for each action; at most the batch", unit="steps"
    )
    learning_rate: float = option(3e-3, "Adam step size", above=0)


@dataclass(frozen=True)
class OracleConfig:
    """method=oracle: rejection sampling of uniform starts by their success (section 5.2)."""

    num_points: int = count(170, "uniform starts tried per round")
    rollouts: int = option(3, "episodes that label each of them", low=2)
    max_rounds: int = count(5, "rounds per curriculum iteration, if num_new good starts are not found before")


@dataclass(frozen=True)
class SelfPlayConfig:
    """method=self_play: Alice proposes num_new starts, one per episode (section 5.2, appendix B.3)."""

    stop_threshold: float = option(
        0.99, "Alice stops where tanh of her last action exceeds this", above=-1, high=0.9999
    )
    horizon_factor: int = count(2, "horizon that Alice and Bob share, in horizons T of the task")


@dataclass(frozen=True)
class RandomizeConfig:
    """Domain randomisation: simulations of the training differ in their physics (engine=native).

    A spread x draws one factor between 1 / (1 + x) and 1 + x for each model; 0: as in the task. Evaluation is in the
    task's own model.
    """

    friction: float = option(
        0.0, "spread x of the friction of all contacts, factors 1 / (1 + x) to 1 + x", low=0, high=99
    )
    mass: float = option(0.0, "spread of the masses and inertias of all bodies", low=0, high=99)
    damping: float = option(0.0, "spread of the damping of all joints", low=0, high=99)
    motor: float = option(0.0, "spread of the force of all actuators", low=0, high=99)
    variants: int = count(64, "models that are drawn; environment i has number i modulo this", high=1_000)


@dataclass(frozen=True)
class EvalConfig:
    """Success on rho_0, the uniform distribution over the task's feasible starts."""

    episodes: int = count(500, "episodes per policy (stochastic, mean) during training")
    final_episodes: int = count(2_000, "episodes per policy at the end of a run")


@dataclass(frozen=True)
class HostsConfig:
    """Several processes that train one run together, on one host or many (docs/devices.md)."""

    coordinator: str = option(
        "none",
        "none: this process is alone; slurm: the processes that srun started; else where process 0 listens",
        pattern=r"none|slurm|[^:/\s]+:[0-9]{1,5}",
        form="none, slurm, or host:port",
    )
    processes: int = count(1, "how many there are, with host:port")
    process: int = option(0, "which of them this is, from 0; process 0 writes all files", low=0)


@dataclass(frozen=True)
class Config:
    """A run."""

    task: str = option("ring_peg", "what to learn; a class of your own: docs/custom_tasks.md")
    method: str = option("reverse", "where training starts come from; a class of your own: docs/custom_methods.md")
    algorithm: str = option("trpo", "train_pol: trpo (the paper's) or ppo", choices=("trpo", "ppo"))
    reward: str = option(
        "sparse", "1 at the goal; distance: less a penalty for it (appendix B.1)", choices=("sparse", "distance")
    )
    distance_weight: float = option(
        0.01, "that penalty; where an episode can fail, it rewards failing early", unit="per metre and step", above=0
    )
    engine: str = option(
        "auto",
        "physics: native (C MuJoCo on CPU threads), mjx (any device, all under jit) or warp (NVIDIA GPUs, "
        "rcg_jax[warp]); auto: the one that suits this machine, and a run says which and why",
        choices=("auto", *ENGINES),
    )
    devices: str = option(
        "1",
        "devices that environments, and seeds, are spread over, of all hosts together; on a CPU, JAX devices of it",
        pattern=r"all|[1-9][0-9]{0,5}",
        form="an integer >= 1, or all",
    )
    matmul_precision: str = option(
        "float32",
        "matrix products on an accelerator; float32: all 24 bits; tensorfloat32: factors rounded to 11; default: what "
        "JAX does, tensorfloat32 on recent NVIDIA GPUs; a CPU computes float32 with all of them",
        choices=MATMUL_PRECISIONS,
    )
    preset: str = option(
        "default",
        "default: ours; paper: the paper's algorithm, its appendix and what its software did beside it (docs/paper.md)",
        choices=("default", "paper"),
    )
    seed: int = option(0, "first random seed", low=0, high=2**31 - 1)
    num_seeds: int = count(1, "seeds seed, seed+1, ... trained in one program", symbol="S", high=1_000)
    iterations: int = count(200, "curriculum iterations; more continue a run", symbol="Iter", high=2**31 - 1)
    run_dir: str = option("runs", "folder of runs; a seed lives in <run_dir>/<task or ClassName>/<method>/seed<k>")
    eval_every: int = option(25, "curriculum iterations between evaluations on rho_0; 0: only at the end", low=0)
    checkpoint_every: int = count(10, "curriculum iterations between checkpoints")
    logger: str = option("none", "what gets all numbers beside CSV and TensorBoard; a class of your own: docs/index.md")
    write_report: bool = option(True, "write report.html, with videos, at the end")
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    trpo: TrpoConfig = field(default_factory=TrpoConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    baseline: BaselineConfig = field(default_factory=BaselineConfig)
    oracle: OracleConfig = field(default_factory=OracleConfig)
    self_play: SelfPlayConfig = field(default_factory=SelfPlayConfig)
    randomize: RandomizeConfig = field(default_factory=RandomizeConfig)
    evaluation: EvalConfig = field(default_factory=EvalConfig)
    hosts: HostsConfig = field(default_factory=HostsConfig)


def flatten(config: Any, prefix: str = "") -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Yields (dotted name, field, value) of every setting, groups last."""
    groups = []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            groups.append((item.name, value))
        else:
            yield prefix + item.name, item, value
    for name, value in groups:
        yield from flatten(value, f"{prefix}{name}.")
