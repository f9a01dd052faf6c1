"""Error maps, histograms, noise floors, incidence, and the Letter's tables."""
