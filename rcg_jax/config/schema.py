"""The settings' dataclasses as a typed OmegaConf tree."""

from __future__ import annotations

from omegaconf import DictConfig, OmegaConf

from rcg_jax.config.settings import Config


def make_schema() -> DictConfig:
    """All defaults, with the types of :class:`Config`; other values can be merged into it."""
    return _writable(OmegaConf.structured(Config))


def _writable(node: DictConfig) -> DictConfig:
    """OmegaConf makes frozen dataclasses read-only; overrides need to write before the frozen object is built."""
    OmegaConf.set_readonly(node, None)
    for name in node:
        child = node._get_node(name)
        if isinstance(child, DictConfig):
            _writable(child)
    return node
