"""Load cells: `sampler` makes samples, `cells` packs them into CAN frames, `transports` carries the frames."""
