"""Calls of Python from compiled programs, by a name and a number that mean the same in every process.

JAX's own callbacks put a pointer of this process into the program, so it does not keep such programs in its persistent
compilation cache. Here a program holds the name of one handler of XLA's foreign function interface and an ``identity``
that the caller derives from what its function computes: a later process that registers the same identity loads the
compiled program from disk. Arguments and results are XLA's own memory, nothing is copied.

The structures are those of ``xla/ffi/api/c_api.h``, version 0.3, which XLA promises to keep for a year. Their sizes are
checked at every call, so that another layout is an error.
"""

from __future__ import annotations

import ctypes
import functools
import traceback
from collections.abc import Callable, Sequence
from ctypes import POINTER, Structure, byref, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p
from typing import Any

import jax
import numpy as np
from jax import Array

#: Inputs, read-only, and outputs to be filled, all of them contiguous views of XLA's buffers.
HostFunction = Callable[[list[np.ndarray], list[np.ndarray]], None]

#: What programs call; the last part is the version of what they pass.
_TARGET = "rcg_jax_host_call_1"

_API_VERSION = (0, 3)
_METADATA = 1
_INTERNAL = 13

#: ``XLA_FFI_DataType``.
_DTYPES = {1: np.bool_, 4: np.int32, 8: np.uint32, 11: np.float32, 12: np.float64}

_FUNCTIONS: dict[int, HostFunction] = {}


class _Version(Structure):
    _fields_ = [("struct_size", c_size_t), ("extension", c_void_p), ("major", c_int), ("minor", c_int)]


class _Metadata(Structure):
    _fields_ = [("struct_size", c_size_t), ("api_version", _Version), ("traits", c_uint32)]


class _Extension(Structure):
    """``XLA_FFI_Metadata_Extension``; the first three fields are those of every extension."""

    _fields_ = [("struct_size", c_size_t), ("type", c_int), ("next", c_void_p), ("metadata", POINTER(_Metadata))]


class _ErrorCreateArgs(Structure):
    _fields_ = [("struct_size", c_size_t), ("extension", c_void_p), ("message", c_char_p), ("code", c_int)]


class _Api(Structure):
    _fields_ = [
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("version", _Version),
        ("internal", c_void_p),
        ("error_create", ctypes.CFUNCTYPE(c_void_p, POINTER(_ErrorCreateArgs))),
    ]


class _Buffer(Structure):
    _fields_ = [
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("dtype", c_int),
        ("data", c_void_p),
        ("rank", c_int64),
        ("dims", POINTER(c_int64)),
    ]


class _List(Structure):
    """``XLA_FFI_Args`` and ``XLA_FFI_Rets``."""

    _fields_ = [
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("size", c_int64),
        ("types", c_void_p),
        ("items", POINTER(POINTER(_Buffer))),
    ]


_LIST_SIZE = ctypes.sizeof(_List)


class _Scalar(Structure):
    _fields_ = [("dtype", c_int), ("value", POINTER(c_int64))]


class _Attributes(Structure):
    _fields_ = [
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("size", c_int64),
        ("types", c_void_p),
        ("names", c_void_p),
        ("items", POINTER(POINTER(_Scalar))),
    ]


class _CallFrame(Structure):
    _fields_ = [
        ("struct_size", c_size_t),
        ("extension", POINTER(_Extension)),
        ("api", POINTER(_Api)),
        ("context", c_void_p),
        ("stage", c_int),
        ("args", _List),
        ("results", _List),
        ("attributes", _Attributes),
    ]


def host_call(
    identity: int, function: HostFunction, outputs: Sequence[jax.ShapeDtypeStruct], *args: Array
) -> list[Array]:
    """``function(inputs, results)`` on the host, in a program for a CPU that may be kept on disk.

    Under vmap all arrays get a further leading axis. The function stays in memory as long as the process.

    Args:
        identity: 63 bits that stand for what ``function`` computes, in this process and in others: two functions
            with the same identity must be interchangeable.
        function: fills its results from its inputs; what it raises becomes a ``JaxRuntimeError`` with its traceback.
        outputs: shapes and types of the results.
        args: float32, float64, int32, uint32 or bool.
    """
    _register()
    _FUNCTIONS[identity] = function
    call = jax.ffi.ffi_call(_TARGET, outputs, vmap_method="broadcast_all")
    return list(call(*args, identity=np.int64(identity)))


@functools.cache
def _register() -> None:
    jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(_handler), platform="cpu")


@ctypes.CFUNCTYPE(c_void_p, POINTER(_CallFrame))
def _handler(pointer: Any) -> int | None:
    """The one handler: XLA asks it for its version, then calls it. Returns an error of XLA's, or None.

    XLA runs a tiny program, of fewer than some thousand operations, on the thread that called it. On the main thread
    Ctrl-C raises here, and is an error to XLA as any other; larger programs know nothing of signals.
    """
    frame = pointer.contents
    if frame.extension and frame.extension.contents.type == _METADATA:
        version = frame.extension.contents.metadata.contents.api_version
        version.major, version.minor = _API_VERSION
        return None
    try:
        if (frame.args.struct_size, frame.results.struct_size, frame.attributes.size) != (_LIST_SIZE, _LIST_SIZE, 1):
            raise RuntimeError("XLA's foreign function interface has another layout in this version of jaxlib")
        inputs, results = _views(frame.args), _views(frame.results)
        for x in inputs:
            x.flags.writeable = False
        _FUNCTIONS[frame.attributes.items[0].contents.value[0]](inputs, results)
    except BaseException:  # nothing may leave a callback of C
        args = _ErrorCreateArgs(ctypes.sizeof(_ErrorCreateArgs), None, traceback.format_exc().encode(), _INTERNAL)
        error: int | None = frame.api.contents.error_create(byref(args))
        return error
    return None


def _views(buffers: Any) -> list[np.ndarray]:
    return [_view(buffers.items[i].contents) for i in range(buffers.size)]


def _view(buffer: Any) -> np.ndarray:
    """XLA's memory as an array."""
    shape, dtype = tuple(buffer.dims[: buffer.rank]), np.dtype(_DTYPES[buffer.dtype])
    size = dtype.itemsize
    for n in shape:
        size *= n
    memory: Any = (ctypes.c_char * size).from_address(buffer.data) if size else bytearray()
    return np.ndarray(shape, dtype, memory)
