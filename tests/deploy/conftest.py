import pytest

from redig.deploy import export_policy, load_policy


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """Export a policy and load it."""

    def through_a_file(policy, seed=None, **options):
        path = tmp_path_factory.mktemp("exported") / "policy.onnx"
        export_policy(policy, path, **options)
        return load_policy(path, seed=seed)

    return through_a_file
