"""Checkpoints: whole states, bit for bit; damage is found; a failed save costs nothing."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from orbax.checkpoint import v1 as ocp

from rcg_jax.runs import checkpoint
from rcg_jax.runs.checkpoint import CheckpointError, CheckpointWriteError, DamagedError


@struct.dataclass
class State:
    key: Any
    params: Any
    mask: Any
    empty: Any
    iteration: Any


def make(seed: int) -> State:
    values = jax.random.normal(jax.random.key(100 + seed), (50, 3)).at[0, 0].set(jnp.nan).at[1, 1].set(-0.0)
    return State(
        key={"batch": jax.random.split(jax.random.key(seed), 3), "other": jax.random.key(seed, impl="rbg")},
        params={"Dense_0": {"kernel": values, "bias": values[0].astype(jnp.bfloat16)}},
        mask=jnp.arange(5) % 2 == 0,
        empty=(jnp.zeros((0, 3)), ()),
        iteration=jnp.int32(seed),
    )


def data(state: State) -> list[bytes]:
    def to_bytes(leaf: Any) -> bytes:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return str(jax.random.key_impl(leaf)).encode() + np.asarray(jax.random.key_data(leaf)).tobytes()
        return f"{leaf.dtype}{leaf.shape}".encode() + np.asarray(leaf).tobytes()

    return [to_bytes(leaf) for leaf in jax.tree.leaves(state)]


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run's checkpoints of iterations 1 and 2."""
    path = tmp_path / "seed0" / "checkpoints"
    for iteration in (1, 2):
        checkpoint.save([path], iteration, [make(iteration)])
    return path


@pytest.mark.parametrize("abstract", [False, True])
def test_a_state_comes_back_bit_for_bit(folder: Path, abstract: bool) -> None:
    like = jax.eval_shape(lambda: make(0)) if abstract else make(0)
    state = checkpoint.load(folder / "2", like)
    assert data(state) == data(make(2))
    assert jax.tree.structure(state) == jax.tree.structure(make(2))
    # The key is used, not only compared.
    assert jax.random.uniform(state.key["other"]) == jax.random.uniform(make(2).key["other"])


@pytest.mark.parametrize("name", ["[8, 8] what?*", "%7B#x ä'\"$"])
def test_folders_may_have_any_name(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name / "checkpoints"
    checkpoint.save([folder], 3, [make(3)])
    assert data(checkpoint.load(folder / "3", make(0))) == data(make(3))


def test_what_orbax_cannot_read_although_it_is_intact_is_not_called_damage(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: Any) -> None:
        raise ValueError("this format is from the future")

    monkeypatch.setattr(ocp, "load", fail)
    with pytest.raises(CheckpointError, match="intact, but cannot be read: this format"):
        checkpoint.restore([folder], make(0))


def test_a_save_that_reads_back_differently_is_none(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = files(folder)
    with monkeypatch.context() as patch:
        original = ocp.save
        patch.setattr(
            ocp, "save", lambda path, arrays: original(path, {k: np.zeros_like(v) for k, v in arrays.items()})
        )
        with pytest.raises(CheckpointWriteError, match="differently"):
            checkpoint.save([folder], 3, [make(3)])
    assert files(folder) == before


def test_the_newest_three_are_kept(folder: Path) -> None:
    for iteration in (3, 10):
        checkpoint.save([folder], iteration, [make(iteration)])
    assert checkpoint.iterations(folder) == [2, 3, 10]


def all_files(path: Path) -> list[str]:
    return sorted(each.relative_to(path).as_posix() for each in path.rglob("*") if each.is_file())


@pytest.mark.parametrize("how", ["flip", "truncate", "delete", "grow", "empty"])
def test_damage_of_any_file_is_found_and_the_one_before_is_used(folder: Path, how: str, tmp_path: Path) -> None:
    for name in all_files(folder / "2"):
        copy = tmp_path / how / "checkpoints"
        shutil.copytree(folder, copy)
        file = copy / "2" / name
        content = file.read_bytes()
        if how in ("flip", "truncate") and not content:
            shutil.rmtree(copy)
            continue
        middle = len(content) // 2
        if how == "flip":
            file.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
        elif how == "truncate":
            file.write_bytes(content[:-1])
        elif how == "delete":
            file.unlink()
        elif how == "grow":
            file.write_bytes(content + b"x")
        elif content:
            file.write_bytes(b"")
        if file.exists() and file.read_bytes() == content:
            shutil.rmtree(copy)
            continue
        restored = checkpoint.restore([copy], make(0))
        assert restored is not None, name
        assert restored.iteration == 1, name
        assert [damage.path for damage in restored.damaged] == [copy / "2"], name
        assert name in restored.damaged[0].reason, restored.damaged[0].reason
        assert data(restored.states[0]) == data(make(1))
        shutil.rmtree(copy)


def test_wrong_arrays_under_right_files_are_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = ocp.load

    def load(path: Any, like: Any) -> Any:
        return {name: value + (value.dtype == np.int32) for name, value in original(path, like).items()}

    monkeypatch.setattr(ocp, "load", load)
    with pytest.raises(DamagedError, match="arrays differ"):
        checkpoint.load(folder / "2", make(0))


def test_another_structure_is_not_called_damage(folder: Path) -> None:
    with pytest.raises(CheckpointError, match=r"mask.*bool\[5\].*bool\[6\]"):
        checkpoint.restore([folder], make(0).replace(mask=jnp.zeros(6, bool)))


@pytest.mark.parametrize("moment", ["orbax", "manifest", "rename"])
def test_a_failed_save_leaves_everything_as_it_was(
    folder: Path, tmp_path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "seed1" / "checkpoints"
    checkpoint.save([other], 2, [make(2)])
    before = files(tmp_path)

    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        if moment == "orbax":
            original = ocp.save
            calls: list[int] = []

            def second_fails(path: Any, arrays: Any) -> None:
                calls.append(1)
                original(path, arrays) if len(calls) < 2 else full()

            patch.setattr(ocp, "save", second_fails)
        elif moment == "manifest":
            patch.setattr(checkpoint, "write_manifest", full)
        else:
            patch.setattr(checkpoint, "_publish", full)
        with pytest.raises(CheckpointWriteError, match=r"^No space left on device$"):
            checkpoint.save([folder, other], 3, [make(3), make(4)])
    assert files(tmp_path) == before
    checkpoint.save([folder, other], 3, [make(3), make(4)])
    assert checkpoint.iterations(folder) == [1, 2, 3]
    assert checkpoint.iterations(other) == [2, 3]


def test_a_half_written_checkpoint_is_ignored_and_removed(folder: Path) -> None:
    shutil.copytree(folder / "2", folder / ".new-3")
    assert checkpoint.iterations(folder) == [1, 2]
    checkpoint.clean(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["1", "2"]


def test_a_kill_while_one_is_replaced_keeps_the_old_one(folder: Path) -> None:
    before = files(folder / "2")
    (folder / "2").rename(folder / ".replaced-2")
    shutil.copytree(folder / "1", folder / ".new-2")
    checkpoint.clean(folder)
    assert files(folder / "2") == before
    assert sorted(path.name for path in folder.iterdir()) == ["1", "2"]


def test_seeds_restore_the_newest_iteration_that_all_have_intact(tmp_path: Path) -> None:
    folders = [tmp_path / f"seed{k}" / "checkpoints" for k in range(2)]
    for iteration in (2, 4, 6):
        checkpoint.save(folders, iteration, [make(iteration), make(iteration + 1)])
    checkpoint.save(folders[:1], 8, [make(8)])
    restored = checkpoint.restore(folders, make(0))
    assert restored is not None
    assert restored.iteration == 6
    file = next(path for path in (folders[1] / "6").rglob("*") if path.is_file() and path.stat().st_size)
    file.write_bytes(b"")
    restored = checkpoint.restore(folders, make(0))
    assert restored is not None
    assert restored.iteration == 4
    assert data(restored.states[1]) == data(make(5))
    assert [damage.path for damage in restored.damaged] == [folders[1] / "6"]


def test_seeds_with_different_histories_are_refused(tmp_path: Path) -> None:
    folders = [tmp_path / f"seed{k}" / "checkpoints" for k in range(2)]
    for iteration in (2, 4):
        checkpoint.save(folders[:1], iteration, [make(iteration)])
    with pytest.raises(CheckpointError, match="num_seeds=1"):
        checkpoint.restore(folders, make(0))


def test_a_first_checkpoint_that_only_one_seed_has_is_no_obstacle(tmp_path: Path) -> None:
    folders = [tmp_path / f"seed{k}" / "checkpoints" for k in range(2)]
    checkpoint.save(folders[:1], 5, [make(5)])
    assert checkpoint.restore(folders, make(0)) is None
