"""The controller process: native step and its binding, loop, fallback, pure pursuit."""
