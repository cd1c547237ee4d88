"""What tests and benches share: emulated rigs as processes, muscles, hostile files, campaigns."""
