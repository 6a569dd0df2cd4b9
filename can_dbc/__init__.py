"""The interface: the DBC, the codec derived from it, end-to-end protection, the bus."""
