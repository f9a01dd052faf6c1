"""Operations that nothing else needs, one a module, found through the entry points
``slviewer.operations`` as those of other packages are."""
