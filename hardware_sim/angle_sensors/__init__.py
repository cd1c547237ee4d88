"""The joint's angle: `encoder` reads it, `sensor` sends it in CAN frames of its own."""
