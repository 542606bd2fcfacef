"""Fields of the C structures between XLA and machine code, and their addresses in LLVM IR."""

_HEAD = "struct_size extension_start"
_VERSION = (
    "api_version.struct_size api_version.extension_start "
    "api_version.major_version+api_version.minor_version"
)

STRUCTURES = {
    "CallFrame": f"{_HEAD} api ctx stage "
    "args.struct_size args.extension_start args.size args.types args.args "
    "rets.struct_size rets.extension_start rets.size rets.types rets.rets "
    "attrs.struct_size attrs.extension_start attrs.size attrs.types attrs.names attrs.attrs",
    "Buffer": f"{_HEAD} dtype data rank dims",
    "Array": "dtype size data",
    "Metadata_Extension": "extension_base.struct_size extension_base.type "
    "extension_base.next metadata",
    "Metadata": f"struct_size {_VERSION} traits",
    "Stream_Get_Args": f"{_HEAD} ctx stream",
    "Error_Create_Args": f"{_HEAD} message errc",
    "ThreadPool_NumThreads_Args": f"{_HEAD} ctx num_threads",
    "ThreadPool_Schedule_Args": f"{_HEAD} ctx task data",
    "Api": f"{_HEAD} {_VERSION} internal_api "
    "XLA_FFI_Error_Create XLA_FFI_Error_GetMessage XLA_FFI_Error_Destroy "
    "XLA_FFI_Handler_Register XLA_FFI_Stream_Get XLA_FFI_Type_Register "
    "XLA_FFI_ExecutionContext_Get XLA_FFI_State_Set XLA_FFI_State_Get "
    "XLA_FFI_DeviceMemory_Allocate XLA_FFI_DeviceMemory_Free "
    "XLA_FFI_ThreadPool_Schedule XLA_FFI_ThreadPool_NumThreads",
    # Our own: what the threads of one call share. The pointers themselves come after it.
    "Job": "users next done blocks claims chunk kernel params args rets scratch",
}
"""The fields of each structure ``XLA_FFI_…`` in the order of ``xla/ffi/api/c_api.h``, a file in
`jax.ffi.include_dir()`. A field takes 8 bytes, also if it is shorter; two joined by + share them.
The layout is that of 64-bit systems, and stable for a major version of the interface."""


def offset(structure: str, field: str) -> int:
    """The position of a field in bytes."""
    for start, fields in enumerate(STRUCTURES[structure].split()):
        if field in fields.split("+"):
            return 8 * start + 4 * fields.split("+").index(field)
    raise KeyError(f"{structure}.{field}")


def size(structure: str) -> int:
    return 8 * len(STRUCTURES[structure].split())


def addresses(pointer: str, structure: str, fields: str) -> str:
    """Instructions for the pointers ``%pointer.field`` to some fields of a structure."""
    return "\n  ".join(
        f"%{pointer}.{field} = getelementptr i8, ptr %{pointer}, i64 {offset(structure, field)}"
        for field in fields.split()
    )
