"""Lenses, rays, transforms, triangulation, plane and sphere fits."""
