"""What the commands share: running one, and sweeps."""
