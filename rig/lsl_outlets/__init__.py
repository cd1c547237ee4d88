"""Lab Streaming Layer: torque and pulses of the running test for LabRecorder and others (`docs/lsl.md`).

A process of its own, `python -m stimrig.rig.lsl_outlets`, of low priority. All it has of the rig is the journal that
the rig writes anyway; it reads the file and shares no socket, no lock and no thread with the rig.
"""
