"""From a folder of photographs, as a phone leaves it, to a capture with poses (§10.1.1)."""
