"""The folder on disk: layout, atomic saves, importers of other tools' folders."""
