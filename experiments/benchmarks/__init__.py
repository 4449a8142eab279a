"""Speed, start-up, memory and scaling, as ratios measured in one run."""
