"""Other tools' folders, one file a layout.

A layout is a module with a ``LAYOUT`` made by `imported.define_layout`, or a function
``read(source, ...)``. It looks at the whole source before it reads a frame, raises InputError for
what is missing or contradicts itself, and returns `imported.Imports`: iterating reads one capture
at a time. Saving is the caller's business. Another layout is another file.
"""
