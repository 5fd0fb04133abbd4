"""How a workspace gets its visits, for the command line and for Python alike: photos placed, compared, kept, told."""
