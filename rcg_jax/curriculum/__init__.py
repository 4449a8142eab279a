"""The curriculum: Brownian walks, select, replay. Only ``choose`` reads the agent: V and its observations."""
