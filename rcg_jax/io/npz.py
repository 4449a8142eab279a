"""Reading npz files that come from elsewhere: what they would take unpacked is looked at before anything is."""

from __future__ import annotations

import io
import math
import zipfile

import numpy as np

#: What a file's arrays need besides their numbers: headers, and texts such as hashes.
_BESIDES = 1 << 14

#: How many times its file an array may be, unpacked, where that is more than so many bytes.
_RATIO, _HARMLESS = 64, 1 << 26


def load_npz(data: bytes, most: int) -> dict[str, np.ndarray]:
    """The arrays of an npz file by name, from its content; no objects.

    Raises:
        ValueError: in memory they would take more than ``most`` bytes or, if they are large, :data:`_RATIO` times the
            file: learned or sampled numbers hardly get smaller by packing. Of a damaged file numpy and zipfile raise
            almost anything.
    """
    most = min(most, max(_HARMLESS, _RATIO * len(data)))
    needed = 0
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for member in archive.infolist():
            with archive.open(member) as packed:
                file = io.BytesIO(packed.read(_BESIDES))
            version = np.lib.format.read_magic(file)  # type: ignore[no-untyped-call]
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)  # type: ignore[no-untyped-call]
            needed += max(member.file_size, math.prod(shape) * dtype.itemsize)
    if needed > most + _BESIDES:
        raise ValueError(f"unpacked it would take {needed:,} bytes, more than the {most:,} that it can need")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}
