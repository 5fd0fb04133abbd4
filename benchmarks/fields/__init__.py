"""How good a field of photographs is, by photos that were left out."""
