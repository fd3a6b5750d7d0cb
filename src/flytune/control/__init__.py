"""What decides: controllers, all behind one protocol."""
