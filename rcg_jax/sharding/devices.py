"""Several devices: one program whose environments are spread over a mesh of seeds x environments.

The algorithm knows nothing of this. The train step is compiled with its mesh as context; XLA partitions it and puts in
the few sums over devices that gradients, Fisher products, line search and labels need. Random numbers are those of one
device, so the results differ from one device's by the order of summation only. Two places say more than XLA could find
out by itself: :func:`each_its_own`, around physics, whose loops would otherwise wait for all devices after each
solver iteration; and :func:`over_devices`, where a batch changes from environments x steps to samples.

Train states are small and stay whole on each device, so a checkpoint knows nothing of devices either.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from typing import Any, TypeVar
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from rcg_jax.config.settings import ConfigError
from rcg_jax.sharding.keys import key_data, wrap_keys

#: Axes of the mesh.
SEEDS, ENVS = "seeds", "envs"

Tree = TypeVar("Tree")


def _mesh_size() -> int:
    """Devices that the environments of the program being traced are spread over; 1 without a mesh."""
    return int(jax.sharding.get_abstract_mesh().shape.get(ENVS, 1))


def each_its_own(fun: Callable[..., Tree]) -> Callable[..., Tree]:
    """``fun`` of pytrees with a leading axis of B environments, computed by each device for its own share of them.

    Its rows must not depend on each other. Where the devices do not divide B, some compute a few rows more.
    """

    @wraps(fun)
    def spread(*args: Any) -> Tree:
        size = _mesh_size()
        if size == 1:
            return fun(*args)
        split = jax.shard_map(fun, in_specs=PartitionSpec(ENVS), out_specs=PartitionSpec(ENVS), check_vma=False)
        rows = jax.tree.leaves(args)[0].shape[0]
        missing = -rows % size
        if not missing:
            return split(*args)
        filled = jax.tree.map(lambda x: jnp.concatenate([x, jnp.repeat(x[:1], missing, axis=0)]), args)
        return jax.tree.map(lambda x: x[:rows], split(*filled))

    return spread


def over_devices(x: Array, axis: int = 0) -> Array:
    """``x`` with this axis spread over the devices that share a batch; ``x`` itself without a mesh."""
    if _mesh_size() == 1:
        return x
    return jax.lax.with_sharding_constraint(x, PartitionSpec(*[None] * axis, ENVS))


@jax.custom_batching.custom_vmap
def any_of_all_seeds(x: Array) -> Array:
    """Whether any of ``x`` is true, () bool; under ``vmap``, any of all the seeds', the same for each of them.

    As the condition of a loop or a branch: with one of its own for each seed, JAX would copy at every step all that the
    loop carries, and take both branches always. What is computed for seeds that did not ask for it must not matter.
    """
    return jnp.any(x)


@any_of_all_seeds.def_vmap
def _any_over_seeds(axis_size: int, in_batched: list[bool], x: Array) -> tuple[Array, bool]:
    return any_of_all_seeds(x), False


@dataclass(frozen=True)
class Devices:
    """What a run computes on: a mesh of seeds x environments; None: one device, and programs without any of this.

    There are ``number`` devices; ``share`` of them share the environments of a seed.
    """

    mesh: Mesh | None = None
    number: int = 1
    share: int = 1

    def check_envs(self, num_envs: int) -> None:
        """Raises ConfigError where the environments of a rollout cannot be shared out evenly."""
        if num_envs % self.share:
            what = f"must be a multiple of {self.share}, the devices that share a seed"
            raise ConfigError(f"devices={self.number}: rollout.num_envs={num_envs} environments {what}")

    def program(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        """``fun``, to be traced with the mesh as context."""
        if self.mesh is None:
            return fun
        mesh = self.mesh.abstract_mesh

        @wraps(fun)
        def call(*args: Any) -> Any:
            with jax.sharding.use_abstract_mesh(mesh):
                return fun(*args)

        return call

    def vmap(self, fun: Callable[..., Any]) -> Callable[..., Any]:
        """``jax.vmap`` over seeds, which are spread over the mesh's axis of seeds."""
        return jax.vmap(fun) if self.mesh is None else jax.vmap(fun, spmd_axis_name=SEEDS)

    def jit(self, jit: Callable[..., Any], fun: Callable[..., Any], **kwargs: Any) -> Any:
        """``jit(fun)`` for arguments that are :meth:`placed`, with results like them."""
        if self.mesh is None:
            return jit(fun, **kwargs)
        return jit(self.program(fun), out_shardings=NamedSharding(self.mesh, PartitionSpec()), **kwargs)

    def placed(self, tree: Tree) -> Tree:
        """``tree``, the same in every process, whole on each device."""
        if self.mesh is None:
            return tree
        whole = NamedSharding(self.mesh, PartitionSpec())

        def place(leaf: Array) -> Array:
            host = np.asarray(leaf)
            return jax.make_array_from_callback(host.shape, whole, lambda index: host[index])

        return wrap_keys(jax.tree.map(place, key_data(tree)), tree)

    def local(self, tree: Tree) -> Tree:
        """What a compiled program returned, on one device of this process: later work on it needs no other process."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def provide(devices: str, processes: int = 1) -> None:
    """Lets a CPU have its share of the JAX devices that the setting ``devices`` asks for, of so many processes.

    Has no effect after the first computation, or where ``XLA_FLAGS`` says how many there are.
    """
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    number = _cores() if devices == "all" else math.ceil(int(devices) / processes)
    if number > 1:
        with suppress(RuntimeError):  # the devices of this process are in use already
            jax.config.update("jax_num_cpu_devices", number)


def start_on_half_the_cores() -> None:
    """Starts JAX with as many threads of its own as half of this machine's cores.

    The threads of ``engine=native`` begin and end a physics step every few hundred microseconds, which takes longer
    where XLA's threads wait for more to do on the same cores. Has no effect after the first computation, or where
    NPROC, XLA's own variable for this, is set.
    """
    if "NPROC" not in os.environ:
        with mock.patch.dict(os.environ, NPROC=str(max(1, _cores() // 2))):  # not for other processes
            jax.devices()


def choose(devices: str, num_seeds: int) -> Devices:
    """The devices that the setting asks for; each of several processes gives as many.

    Seeds need nothing of each other: as many devices as divide them take whole seeds, the rest share each seed's
    environments.

    Raises:
        ConfigError: there are not so many, or the processes cannot share them evenly.
    """
    processes, here = jax.process_count(), jax.local_device_count()
    number = jax.device_count() if devices == "all" else int(devices)
    if number % processes:
        raise ConfigError(f"devices={devices}: must be a multiple of the {processes} processes of this run, or all")
    if number > here * processes:
        what = f"{jax.devices()[0].platform} devices" + (f" in {processes} processes" if processes > 1 else "")
        raise ConfigError(f"devices={devices}: there are {here * processes} {what}; must be <= that, or all")
    if number == 1:
        return Devices()
    chosen = [device for k in range(processes) for device in jax.local_devices(k)[: number // processes]]
    groups = math.gcd(number, num_seeds)
    mesh = jax.make_mesh((groups, number // groups), (SEEDS, ENVS), (AxisType.Auto,) * 2, devices=chosen)
    return Devices(mesh, number, number // groups)
