"""Reading dimensions off a surface: fitted shapes, distances, sections, and deviation from a
nominal model."""
