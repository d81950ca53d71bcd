"""What stands in the room: lenses, cameras, targets of known geometry."""
