"""Arrays and text on disk, durable and checked."""
