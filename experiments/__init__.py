"""One file per table or figure; each is a command with --help, and writes pictures beside its numbers."""
