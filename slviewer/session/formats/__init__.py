"""File formats of points and meshes, one a module, each called ``FORMAT`` in it; all modules of the
package are found."""
