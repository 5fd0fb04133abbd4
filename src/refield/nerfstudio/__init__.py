"""In from nerfstudio: what a run of ``nerfacto`` left behind, read without running any of it."""
