"""The folder on disk: layout, atomic saves, importers of other tools' folders, exporters.

`store.Session` is the only access. A session folder holds

=========================  =========================================================================
`session.json`             schema number, when and by which version it was made
`captures/<name>/`         `capture.json` (role, pattern sequence, content hash, source, settings),
                           `frames.zarr` (Zarr v3, one uncompressed chunk a frame; of several
                           exposures one after the other), `texture.png` where the texture has
                           colour
`results/<name>/`          `meta.json` and one `.npy` an array; the name may hold slashes
`rigs/<name>.toml`         the operator's own rigs
`decisions.json`           what the operator decided, such as captures excluded and why
`trash/`                   what was replaced or deleted
`exports/`                 files for other programs
=========================  =========================================================================

A capture or result is written next to its place, synced, and renamed in: it is complete or absent,
whatever happens.
"""
