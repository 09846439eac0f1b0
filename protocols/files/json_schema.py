"""The JSON schema of protocol files, made from the models that read them."""

from __future__ import annotations

from typing import Any, Final

from protocols.files.schema import VERSION, Protocol

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_REFERENCE: Final = {"type": "string", "pattern": r"^\$[a-z][a-z0-9_]*$"}
_PLAIN: Final = ("integer", "number", "boolean")


def protocol_schema() -> dict[str, Any]:
    """Return the schema; its `$id` ends in the version of the language.

    Numbers may also be references to parameters, which are texts in the file.
    """
    made = Protocol.model_json_schema()
    schema: dict[str, Any] = _with_references(made)
    schema["properties"]["version"] = {"type": "integer", "minimum": 1, "maximum": VERSION}
    return {"$schema": DIALECT, "$id": f"urn:bramah:protocol:{VERSION}", **schema}


def _with_references(node: Any) -> Any:
    if isinstance(node, list):
        return [_with_references(item) for item in node]
    if not isinstance(node, dict):
        return node
    if node.get("type") in _PLAIN and "const" not in node:
        about = {k: node[k] for k in ("title", "description", "default") if k in node}
        rest = {k: v for k, v in node.items() if k not in about}
        return {**about, "anyOf": [rest, _REFERENCE]}
    return {key: _with_references(value) for key, value in node.items()}
