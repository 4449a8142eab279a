"""The trained policies that come with this package: ``python -m rcg_jax.policies`` lists them.

Each was exported from a finished run (:mod:`rcg_jax.export`); ``rcg_jax.load_policy(NAME)`` reads it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rcg_jax.io.assets import POLICIES
from rcg_jax.io.console import lenient_output
from rcg_jax.policies.card import PolicyCard, Score
from rcg_jax.policies.policy_file import PolicyFileError, read_card, shipped_policies


def table(cards: dict[str, PolicyCard]) -> str:
    """Policies by name, one line each: what they were trained with, and their success on rho_0."""

    def success(score: Score) -> str:
        return f"{score.rate:.3f} [{score.low:.3f}, {score.high:.3f}]"

    header = (
        f"{'policy':<16}{'task':<16}{'method':<12}{'steps':>8}  {'success on rho_0':<22}{'mean action':<22}episodes"
    )
    lines = [
        f"{name:<16}{card.task:<16}{card.method:<12}{card.env_steps / 1e6:>7.1f}M  {success(card.stochastic):<22}"
        f"{success(card.mean):<22}{card.mean.episodes:>8}"
        for name, card in cards.items()
    ]
    return "\n".join([header, *lines])


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words:
        asked = words[0] in ("-h", "--help")
        print("usage: python -m rcg_jax.policies", file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    try:
        print(table({name: read_card(POLICIES / f"{name}.npz") for name in shipped_policies()}))
    except PolicyFileError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
