"""The curriculum: Brownian walks, selection, replay. It knows nothing of policies."""
