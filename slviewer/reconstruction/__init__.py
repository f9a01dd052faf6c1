"""From phase to an organised cloud, normals, and PLY."""
