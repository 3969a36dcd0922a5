// What a torch without CUDA lacks for a backward pass over tensors that say they are on a card: a
// guard of the device, somebody who says that there is one, and the answer that it is the
// accelerator. Loaded before torch (LD_PRELOAD), since torch asks once and then remembers.

#include <ATen/DeviceAccelerator.h>
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>

using namespace c10;

const Device CARD(DeviceType::CUDA, 0);
const Stream STREAM(Stream::DEFAULT, CARD);

struct Guard : impl::NoOpDeviceGuardImpl<DeviceType::CUDA> {
  Device exchangeDevice(Device) const noexcept override { return CARD; }
  Device getDevice() const noexcept override { return CARD; }
  Stream getStream(Device) const noexcept override { return STREAM; }
  Stream getDefaultStream(Device) const noexcept override { return STREAM; }
  Stream exchangeStream(Stream) const noexcept override { return STREAM; }
  void record(void**, const Stream&, const DeviceIndex, const EventFlag) const noexcept override {}
  void block(void*, const Stream&) const noexcept override {}
};

struct CUDAHooks : at::CUDAHooksInterface {
  explicit CUDAHooks(at::CUDAHooksArgs) {}
  void init() const override {}
  bool hasCUDA() const override { return true; }
  bool hasPrimaryContext(DeviceIndex) const override { return true; }
};

namespace c10::impl { C10_REGISTER_GUARD_IMPL(CUDA, Guard) }
namespace at { using ::CUDAHooks; REGISTER_CUDA_HOOKS(CUDAHooks); }
namespace at::accelerator {
std::optional<DeviceType> getAccelerator(bool) { return DeviceType::CUDA; }
}
