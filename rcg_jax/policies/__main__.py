"""The trained policies that come with this package: ``python -m rcg_jax.policies`` lists them.

Each was exported from a finished run (:mod:`rcg_jax.export`); ``rcg_jax.load_policy(NAME)`` reads it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rcg_jax.io.assets import POLICIES
from rcg_jax.io.console import lenient_output
from rcg_jax.policies.card import Score
from rcg_jax.policies.policy_file import PolicyFileError, read_card, shipped_policies


def _success(score: Score) -> str:
    return f"{score.rate:.3f} [{score.low:.3f}, {score.high:.3f}]"


@lenient_output()
def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words:
        asked = words[0] in ("-h", "--help")
        print("usage: python -m rcg_jax.policies", file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    try:
        cards = {name: read_card(POLICIES / f"{name}.npz") for name in shipped_policies()}
    except PolicyFileError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    form = "{:<16}{:<16}{:<12}{:>8}  {:<22}{:<22}{:>8}"
    print(form.format("policy", "task", "method", "steps", "success on rho_0", "mean action", "episodes"))
    for name, card in cards.items():
        scores = _success(card.stochastic), _success(card.mean)
        print(form.format(name, card.task, card.method, f"{card.env_steps / 1e6:.1f}M", *scores, card.mean.episodes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
