"""Load cells: `cells` lays samples out in CAN frames, `transports` carries frames, `sampler` makes samples."""
