"""The local page: photographs with the model on them, dragged until it fits; every answer is that of a command."""
