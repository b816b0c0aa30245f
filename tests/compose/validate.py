"""Validates a compose file against the Compose Specification: validate.py SCHEMA FILE."""
import json
import sys

import jsonschema
import yaml

with open(sys.argv[1], encoding="utf-8") as schema, open(sys.argv[2], encoding="utf-8") as file:
    validator = jsonschema.Draft7Validator(json.load(schema))
    errors = [f"{list(error.path)}: {error.message}" for error in validator.iter_errors(yaml.safe_load(file))]
print("\n".join(errors))
sys.exit(bool(errors))
