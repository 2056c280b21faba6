"""The update compiled: what the compiler needs, graphs that are kept on disk, and graphs compiled side by side.

No equation lives here; `torchelev.pipeline` has the same stages uncompiled.
"""
