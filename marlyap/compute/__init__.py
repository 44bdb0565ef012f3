"""What changes speed only: devices, and what is compiled once and kept."""
