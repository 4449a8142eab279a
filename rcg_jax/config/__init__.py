"""Settings of a run: what there is, what is allowed, and how the command line becomes a :class:`Config`."""

from rcg_jax.config.settings import Config as Config
from rcg_jax.config.settings import ConfigError as ConfigError
from rcg_jax.config.settings import flatten as flatten
from rcg_jax.config.settings import option as option
