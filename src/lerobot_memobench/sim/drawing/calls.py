"""The GL functions of a frame, called without PyOpenGL around them.

PyOpenGL converts arguments and asks for errors at every call, a tenth of the time of a frame. Here arrays are given
by their address, and whoever draws asks once per frame. What is called once, to set up, stays with PyOpenGL.
"""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

_TYPES = {
    "b": ctypes.c_ubyte,
    "f": ctypes.c_float,
    "i": ctypes.c_int,
    "n": ctypes.c_ssize_t,
    "p": ctypes.c_void_p,
    "u": ctypes.c_uint,
}
_ARGUMENTS = {
    "glActiveTexture": "u",
    "glBindBuffer": "uu",
    "glBindBufferBase": "uuu",
    "glBindFramebuffer": "uu",
    "glBindTexture": "uu",
    "glBindVertexArray": "u",
    "glBlendFunc": "uu",
    "glBlitFramebuffer": "iiiiiiiiuu",
    "glBufferData": "unpu",
    "glClear": "u",
    "glClearColor": "ffff",
    "glDepthMask": "b",
    "glDisable": "u",
    "glDrawElements": "uiup",
    "glEnable": "u",
    "glFrontFace": "u",
    "glPixelStorei": "ui",
    "glPolygonOffset": "ff",
    "glReadPixels": "iiiiuup",
    "glUseProgram": "u",
    "glViewport": "iiii",
}


def frame_calls() -> SimpleNamespace:
    """Return the functions by their names, from the library that PyOpenGL has loaded; a context has been opened.

    ``glGetError`` gives a number, the others nothing.
    """
    from OpenGL.platform import PLATFORM

    library = PLATFORM.GL
    make = PLATFORM.functionTypeFor(library)
    calls = {
        name: make(None, *(_TYPES[letter] for letter in letters))((name, library))
        for name, letters in _ARGUMENTS.items()
    }
    return SimpleNamespace(glGetError=make(ctypes.c_uint)(("glGetError", library)), **calls)
