"""The paper's closed forms, which only initialise."""
