"""What other programs can open of a scene: points, a mesh, Gaussian splats, cameras, changes."""
