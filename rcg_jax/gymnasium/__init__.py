"""Tasks as environments of Gymnasium; :mod:`rcg_jax.gymnasium.sb3` is for Stable-Baselines3."""

from rcg_jax.gymnasium.env import TaskEnv as TaskEnv
from rcg_jax.gymnasium.env import make as make
from rcg_jax.gymnasium.vector_env import TaskVectorEnv as TaskVectorEnv
from rcg_jax.gymnasium.vector_env import make_vec as make_vec
