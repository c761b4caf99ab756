"""Fields on the deformed surface, for ParaView and for pictures."""
