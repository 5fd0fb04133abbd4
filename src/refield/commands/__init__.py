"""One file per command of the command line; each joins the stages and holds no method of its own."""
