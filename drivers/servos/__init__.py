"""Code common to all vendors of bus servos: request and answer, handshake, and the joints as a source."""
