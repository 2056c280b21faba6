"""The one boundary between tensors and compiled code.

`registry` derives C structs from declarations, `cpu_build` and `cuda_build` compile, `choose` picks a backend once per
update. No equation lives here: those are in `stages/<stage>/equation.h`.
"""
