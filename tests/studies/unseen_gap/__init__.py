"""The diagnosis judged by a robot in MuJoCo, which shares no code with the twin."""
