"""Several processes, on one host or many, that train one run together: ``jax.distributed``, and who writes what.

All processes run the same program in the same order. Process 0 alone reads and writes files and shows progress; the
others learn from it what it read. None of them can go on without the others: where one is asked to stop, all stop after
the same iteration, and where one dies, the others end with a message.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import NoReturn, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from rcg_jax.config.settings import ConfigError, HostsConfig
from rcg_jax.io.console import one_line
from rcg_jax.sharding.keys import key_data, wrap_keys

#: Seconds without a sign of life after which a process counts as dead; that a run waits for all of its processes to
#: come; and that the others wait at the end, while the first one draws pictures and writes reports.
_HEARTBEAT_S, _ARRIVAL_S, _PARTING_S = 60, 300, 3600

_SLURM = ("SLURM_JOB_ID", "SLURM_NTASKS", "SLURM_PROCID", "SLURM_LOCALID", "SLURM_STEP_NODELIST")

Tree = TypeVar("Tree")


class ConnectError(RuntimeError):
    """The processes of a run did not find each other; the message is one line."""


def number_of_processes(hosts: HostsConfig) -> int:
    """How many processes share a run, by settings or by SLURM's environment.

    Raises:
        ConfigError: ``hosts.coordinator=slurm`` outside of SLURM.
    """
    if hosts.coordinator != "slurm":
        return hosts.processes
    for name in _SLURM:
        if name not in os.environ:
            raise ConfigError(f"hosts.coordinator=slurm: {name} is not set; start the processes with srun")
    return int(os.environ["SLURM_NTASKS"])


@dataclass(frozen=True)
class Hosts:
    """This process among those of its run: its number, and how many there are."""

    index: int = 0
    number: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process reads, writes and speaks for all."""
        return self.index == 0

    def told(self, tree: Tree) -> Tree:
        """The first process's ``tree``, bit for bit, in all processes; shapes and types have to be the same in all."""
        if self.number == 1:
            return tree
        leaves, structure = jax.tree.flatten(key_data(tree))
        leaves = [np.asarray(leaf) for leaf in leaves]
        # As bytes: summing numbers with the zeros of the other processes would not keep each of them as it is.
        sent = np.frombuffer(b"".join(leaf.tobytes() for leaf in leaves), np.uint8)
        rest = np.asarray(multihost_utils.broadcast_one_to_all(sent)).tobytes()
        got = []
        for leaf in leaves:
            got.append(jnp.asarray(np.frombuffer(rest[: leaf.nbytes], leaf.dtype).reshape(leaf.shape)))
            rest = rest[leaf.nbytes :]
        return wrap_keys(jax.tree.unflatten(structure, got), tree)

    def any_signal(self, signum: int | None) -> int | None:
        """The signal that any of the processes was sent, in all of them; None if there was none."""
        if self.number == 1:
            return signum
        return int(np.max(multihost_utils.process_allgather(np.int32(signum or 0)))) or None

    def part(self) -> None:
        """Waits until all processes are done with this run; none of them can be told anything after it."""
        if self.number > 1:
            jax.distributed.shutdown()

    def leave(self, code: int) -> NoReturn:
        """Ends this process at once: an orderly end would wait for the others, which may wait for this one."""
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


#: A process without others.
ALONE = Hosts()


def is_connection_loss(error: Exception) -> bool:
    """Whether a computation of several processes failed, as it does where one of them has ended."""
    # JAX passes some of the network's failures on as plain ValueError.
    return isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error)


def connect(hosts: HostsConfig) -> Hosts:
    """Joins the other processes of the run, if there are any; before the first computation.

    Raises:
        ConfigError: ``hosts.coordinator=slurm`` outside of SLURM.
        ConnectError: they do not all come, or the address cannot be used.
    """
    if hosts.coordinator == "none":
        return ALONE
    number = number_of_processes(hosts)
    if number == 1:
        print(f"hosts.coordinator={hosts.coordinator}: this run has one process", flush=True)
        return ALONE
    slurm = hosts.coordinator == "slurm"
    index = int(os.environ["SLURM_PROCID"]) if slurm else hosts.process
    where = "as SLURM says" if slurm else f"at {hosts.coordinator}"
    print(f"process {index} of {number}: meeting the others {where}, for up to {_ARRIVAL_S} s", flush=True)
    # SIGTERM is ours: every process saves what it is at (rcg_jax.runs.interrupt).
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(
            coordinator_address=None if slurm else hosts.coordinator,
            num_processes=number,
            process_id=index,
            cluster_detection_method="slurm" if slurm else "deactivate",
            initialization_timeout=_ARRIVAL_S,
            heartbeat_timeout_seconds=_HEARTBEAT_S,
            shutdown_timeout_seconds=_PARTING_S,
        )
    except (RuntimeError, ValueError) as error:
        what = f"hosts.coordinator={hosts.coordinator}: process {index} of {number}"
        raise ConnectError(f"{what}: {one_line(error, 160)}") from error
    return Hosts(index, number)
