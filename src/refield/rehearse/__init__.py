"""Rehearsals: known objects and changes put into the photos of a scene, to learn what an update is worth there."""
