"""How the parts are joined: wiring, the loop, referee, records, reports, command line."""
