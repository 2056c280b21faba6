"""The stages of the paper's overview figure, one file or folder each, with their configs.

Each is a pure function `verb(state, ...) -> state`. Their order is in `torchelev.pipeline`.
"""
