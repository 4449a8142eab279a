"""Who takes part: the program that trains, and the packages that it stands for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Entrant:
    """One trainer.

    Attributes:
        module: of ``experiments.race``: ``python -m`` trains, its ``load`` reads a snapshot.
        package: whose version is reported.
        words: what it is, for tables.
        rival: whether it needs the environment of ``make race-env``.
        starts: where its training episodes begin.
    """

    module: str
    package: str
    words: str
    rival: bool = True
    starts: str = "rho_0"


_SB3, _BRAX = "experiments.race.sb3", "experiments.race.brax_ppo"

#: By name, in the order in which they run.
ENTRANTS = {
    "ours": Entrant(
        "experiments.race.ours",
        "rcg_jax",
        "rcg_jax, reverse curriculum from the goal state",
        rival=False,
        starts="goal state",
    ),
    "ours_ppo": Entrant(
        "experiments.race.ours", "rcg_jax", "rcg_jax, the same with algorithm=ppo", rival=False, starts="goal state"
    ),
    "sac_her": Entrant(_SB3, "stable_baselines3", "Stable-Baselines3 SAC + HER"),
    "tqc_her": Entrant(_SB3, "sb3_contrib", "sb3-contrib TQC + HER"),
    "ppo": Entrant(_SB3, "stable_baselines3", "Stable-Baselines3 PPO"),
    "trpo": Entrant(_SB3, "sb3_contrib", "sb3-contrib TRPO"),
    "crossq": Entrant(_SB3, "sbx-rl", "sbx CrossQ"),
    "brax_ppo": Entrant(_BRAX, "brax", "Brax PPO"),
    "ppo_rcg": Entrant(_SB3, "stable_baselines3", "Stable-Baselines3 PPO with our curriculum", starts="goal state"),
    "sac_her_rcg": Entrant(
        _SB3, "stable_baselines3", "Stable-Baselines3 SAC + HER with our curriculum", starts="goal state"
    ),
}
