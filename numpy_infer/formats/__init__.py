"""One file per marker format. `numpy_infer.recordings` picks the right one.

Every reader is `read(path, *, unit=None, left_handed=False) -> Recording`, every writer
`write(recording, path) -> None`.
"""
