"""Policy optimisation: rollouts, advantages, TRPO. It knows nothing of where starts come from."""
