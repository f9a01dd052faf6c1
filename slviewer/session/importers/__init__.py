"""Other tools' folders.

A layout is a `FolderLayout`, made by `imported.define_layout` or of a function ``read(source,
...)``. It looks at the whole source before it reads a frame, raises InputError for what is missing
or contradicts itself, and returns `imported.Imports`: iterating reads one capture at a time. Saving
is the caller's business. `layouts` lists them all.
"""
