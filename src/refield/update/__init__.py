"""Make it so: the field of the changed scene (§4.1). Meets `refield.estimate` only in the type SceneChange."""
