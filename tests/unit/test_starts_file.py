"""Files of starts: what goes in comes out, and damage never goes unnoticed."""

from __future__ import annotations

import numpy as np
import pytest

from rcg_jax.io.starts_file import StartsFileError, encode_starts, hash_starts, load_states, starts_hash
from rcg_jax.tasks.ring_peg import RingPeg


def test_starts_file_round_trip(tmp_path):
    qpos = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    path = tmp_path / "starts.npz"
    path.write_bytes(encode_starts(qpos))
    np.testing.assert_array_equal(load_states(path)[0], qpos)
    assert starts_hash(path) == hash_starts(qpos)
    assert encode_starts(qpos) == path.read_bytes()
    assert (
        len({hash_starts(qpos), hash_starts(qpos[::-1]), hash_starts(qpos.reshape(7, 5)), hash_starts(qpos[:4])}) == 4
    )


def test_damaged_files_are_never_read_as_other_starts(tmp_path):
    qpos = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    content = encode_starts(qpos)
    path = tmp_path / "starts.npz"
    errors = []
    for position in range(len(content)):
        path.write_bytes(content[:position] + bytes([content[position] ^ 0xFF]) + content[position + 1 :])
        try:
            # Some bytes of a zip archive mean nothing, such as its time stamps.
            np.testing.assert_array_equal(load_states(path)[0], qpos)
        except StartsFileError as error:
            errors.append(str(error))
    assert len(errors) > 0.5 * len(content)
    assert all(str(path) in error and "damaged" in error and "\n" not in error for error in errors)
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(StartsFileError, match="damaged file of starts"):
            load_states(path)[0]


def test_task_refuses_damaged_missing_and_foreign_starts(tmp_path):
    class Other(RingPeg):
        feasible_file = tmp_path / "other.npz"

    other = Other("native")
    with pytest.raises(FileNotFoundError, match=r"python -m rcg_jax\.feasible 'task=.*Other'"):
        other.feasible_starts()
    qpos = np.asarray(other.goal_state, np.float32)[None]
    np.savez_compressed(Other.feasible_file, qpos=qpos, sha256=np.array(hash_starts(qpos + 1)))
    with pytest.raises(StartsFileError, match="does not match its hash"):
        other.feasible_starts()
    Other.feasible_file.write_bytes(encode_starts(np.zeros((3, 2))))
    with pytest.raises(StartsFileError, match="2 positions per start, Other has 7"):
        other.feasible_starts()
